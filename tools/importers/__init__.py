"""Importers of public data sets: one file each, from their files as published to messages of the wire contract.

`published.py` opens a table and says what is wrong with it, a data set's own file turns the table into drives,
`resample.py` and `drive.py` turn drives into what a logger would have sent every few seconds.
"""
