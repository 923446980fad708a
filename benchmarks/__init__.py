"""The suites of benchmark.py: run time against error, measured in one process.

A suite is a module named in `options.SUITES`. It has

measure(options, console) -> results    a dictionary of what JSON can hold; raises InputError for
                                        unknown names and impossible values
tables(results) -> rich tables          each made by `table.make_table`
TRACKED                                 the `compare.TrackedMetrics` that compare=old.json compares

and may have

plot(results) -> figure                 written to <suite>.png
verdict(results) -> message or None     a failure; printed at the end, and the exit status is 1
"""
