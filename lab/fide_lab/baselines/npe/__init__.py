"""Neural posterior estimation with truncated proposals, by the library sbi.

`search`      the rounds: what is asked, what is learned, what is saved
`flow`        the network: an embedding of the image and a spline flow, built and trained by sbi
`truncated`   draws from the prior, cut to where the flow has its mass
`canonical`   one order of exchangeable things
"""
