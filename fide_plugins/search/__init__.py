"""Search: a distribution that is refined from generation to generation, and where it begins.

================  ==============================================================================
file              idea
================  ==============================================================================
`one_search`      one search, from its start until it is over
`cma_es`          its distribution: CMA-ES that takes candidates it did not draw (Sec. 3.3)
`step_size`       the step size where parameters are many
`boundary`        the walls of the unit cube, and parameters that wrap around
`mixed`           integers, choices and periodic parameters
`margin`          keeps the distribution from settling on one value of an integer or a choice
`termination`     when a search is over
`validity`        points that satisfy constraints
`memory`          samples that are kept for later pictures and for `Solution.std`
`recall`          where the search for another picture begins
`scene/`          what has been found out about the scene
`moves/`          where to go on when a search has stalled
================  ==============================================================================
"""
