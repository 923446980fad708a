"""Run time against error, in one process: the suites of benchmark.py.

A suite is a folder named in `options.SUITES`; its suite.py has three functions, and what of the
results compare=old.json looks at:

measure(options, console) -> results    plain numbers, words, lists and dictionaries
tables(results) -> rich tables          by `table.make_table`
plot(results) -> figure                 by `plot.time_against_error`, `bars` or `against_seconds`
WATCHED                                a `compare.Watched`

It may have two more:

page(results) -> Markdown               written as <suite>.md
verdict(results) -> sentence or None    a complaint, printed at the end; the exit status is 1
"""
