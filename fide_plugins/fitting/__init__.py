"""One call that fits: workers, failures, checkpoints, callbacks and a result.

    from fide_plugins import fit
    result = fit(render, target, space, budget=2000, workers=8)

===============  ==============================================================================
`one_call`       `fit`: checks the arguments
`fitting`        a fit that is ready to start: saved by time, and how it ends
`loop`           as many renders under way as there are workers, each told when it arrives
`workers/`       where renders happen
`rendering`      one render: an image, or what went wrong
`failures`       renders that gave no image, and when to give up
`around_answer`  renders around the answer, which say how sure it is
`stopping`       when a fit is over
`durations`      "10m"
`result`         what it has found
`result_page`    the same as HTML
`suspicions`     what the best image says about all renders
`saved_run`      its run directory
`load`           a result of a run directory
`run_files`      the optimizer of one, and a copy
`pictures`       images of several views
`callbacks/`     who watches it, and who stops it
`progress`       a bar in a terminal
`checking/`      what to know of a renderer before a fit
===============  ==============================================================================

Nothing is imported here: worker processes load `rendering`, and no PyTorch.
"""
