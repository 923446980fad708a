"""The suites of benchmark.py: run time against error, measured in one process.

A suite is a module named in `options.SUITES`. It has

measure(options, console) -> results    plain numbers, words, lists and dictionaries; InputError
                                        for unknown names and values that cannot be
tables(results) -> rich tables          made by `table.make_table`
WATCHED                                 what compare=old.json compares: a `compare.Watched`

and may have

plot(results) -> figure                 written as <suite>.png
verdict(results) -> sentence or None    a failure, printed at the end; the exit status is 1
"""
