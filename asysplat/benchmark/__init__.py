"""The suites of benchmark.py: run time against error, measured in one process.

A suite is a module named in `options.SUITES`. It has

measure(options, console) -> results    plain numbers, words, lists and dictionaries
tables(results) -> rich tables          made by `table.make_table`
plot(results) -> figure                 made by `plot.time_against_error` or `plot.bars`
WATCHED                                 what compare=old.json compares: a `compare.Watched`

and may have

page(results) -> Markdown               written as <suite>.md in place of the tables
verdict(results) -> sentence or None    a failure, printed at the end; the exit status is 1
"""
