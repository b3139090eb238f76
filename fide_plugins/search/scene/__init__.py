"""What has been found out about the scene: its parameters, and its local optima.

`search.moves.base.Known` holds all of it.  Moves use it, and so do the optimizer's readings: its
solutions, their probabilities and their standard deviations.  Nothing here knows a move.

==================  ===========================================================================
file                idea
==================  ===========================================================================
`axes`              which axes are one parameter, and which wrap around
`exchangeability`   which blocks of parameters can be swapped without a change of the image
`removal`           what each exchangeable block contributes to the image
`sensitivity`       which parameters change the same places of the image
`values`            other values of integers and choices, and which of them were searched
`optima`            the distinct local optima
`modes`             how probable each of several answers is, by a learned model
==================  ===========================================================================
"""
