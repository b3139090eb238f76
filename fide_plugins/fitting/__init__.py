"""One call that fits: workers, failures, checkpoints, callbacks and a result.

    from fide_plugins import fit
    result = fit(render, target, space, budget=2000, workers=8)

===============  ==============================================================================
`one_call`       `fit`: checks the arguments
`loop`           ask, render, tell, record, stop: the loop of `fit` and of the runs of the lab
`fitting`        a fit that is ready to start: its steps, saved by time, and how it ends
`rendering`      one render: an image, or what went wrong
`pictures`       images of several views
`workers`        where renders happen
`processes`      processes that render, each of which can be killed
`failures`       renders that gave no image, when to give up, what looks wrong with all renders
`stopping`       when a fit is over
`around_answer`  renders around the answer, which say how sure it is
`result`         what it has found, also as HTML
`saved_run`      its run directory, and a result of one
`callbacks/`     who watches it, and who stops it
`checking/`      what to know of a renderer before a fit
===============  ==============================================================================

Nothing is imported here: worker processes load `rendering`, and no PyTorch.
"""
