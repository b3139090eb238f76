"""Experiments: one run, comparisons of many runs, sweeps of options, and their reports.

===========  ==================================================================
`run`        one optimizer on one task: the run loop and its directory
`compare`    many runs: tasks x losses x configurations x seeds
`sweep`      comparisons over combinations of options, and their Pareto front
`report`     tables, charts and one HTML page about a comparison
`solutions`  several candidates of a run, side by side
`suite`      a fixed set of problems, and the page of its results
===========  ==================================================================
"""
