"""The laboratory of FIDE: figures and pages of runs, rivals, comparisons and their reports.

Nothing in `fide_plugins` needs it but names, such as the loss `lpips`.

============  ==================================================================
`figures`     figures of runs
`checking`    a look at a renderer before a fit
`solutions`   distinct candidates of a run, side by side
`watch`       the page of a run, while it goes on
`baselines`   rivals with the ask/tell protocol of FIDE
`optimizers`  every optimizer by name: FIDE, its rivals, and what others register
`run`         one optimizer on one task: the run loop
`compare`     many runs: tasks x losses x configurations x seeds
`sweep`       comparisons over combinations of options, and their Pareto front
`report`      tables, charts and one HTML page about a comparison
`suite`       a fixed set of problems, and the page of its results
`pretrained`  encoders and a loss of pretrained networks
`cli`         commands of `fide` for all of these
============  ==================================================================
"""
