"""Import public data sets of real drives as messages of the wire contract.

Each data set has its own module, which turns its published tables into drives: `ved`, `bmw_i3`, `twizy`. `data_sets`
lists them. `published` reads tables and reports what is wrong with a file. `drive` turns a drive into the samples that
a logger with a period of a few seconds would have sent. `synthetic_shifts` concatenates drives into shifts.
"""
