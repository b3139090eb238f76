"""Search: a distribution that is refined from generation to generation, and where it begins.

================  ==============================================================================
file              idea
================  ==============================================================================
`one_search`      one search, from its start until it is over
`cma_es`          its distribution: CMA-ES that takes candidates it did not draw (Sec. 3.3)
`mixed`           the walls of the unit cube; integers, choices and periodic parameters
`validity`        points that satisfy constraints
`memory`          samples that are kept for later pictures and for `Solution.std`
`recall`          where the search for another picture begins
`scene`           what has been found out about the scene
`exchangeability` which blocks of parameters can be swapped without a change of the image
`moves`           where to go on when a search has stalled
`hypotheses`      where a learned model believes the answer to be, and what it leaves open
`policy`          which move comes next, and what must be known for it
================  ==============================================================================
"""
