"""Tables of years of recordings on many machines, equal to the serial ones to the bit.

`tables.py` composes the stages and writes the tables: `decoding.py` decodes spans of time in parallel and parts their
samples by car, `ordering.py` finds in one pass over the messages whatever couples cars to each other, `cleaning.py`
cleans the cars of each part in parallel, and `displays.py` learns in order what the displays of all cars stand for.
`runner.py` runs the tasks, in this process or by Dask (`dask_runner.py`).
"""
