"""Where to go on when a search has stalled: a family of moves, chosen by what they brought.

A loss of images has many local optima that no small step leaves: two cells stand for one of the
target's and one for two, a wrist is turned around, a layer is painted too early. A local optimum is
mostly right, so a move keeps most of it.

==================  ===========================================================================
file                idea
==================  ===========================================================================
`policy`            what the next generation is for: `MovePolicy`, the only class that `FIDE` calls
`base`              what a move is, and what all moves know
`axes`              which axes are one parameter, and which wrap around
`exchangeability`   which blocks of parameters can be swapped without a change of the image
`removal`           what each exchangeable block contributes to the image
`sensitivity`       which parameters change the same places of the image
`split`             a redundant block becomes a copy of one that has too much to do
`relocate`          a parameter group at a random place
`swap`              two groups with their values exchanged
`crossover`         a segment of parameters from another local optimum
`half_turn`         angles that look alike: half a turn away, mirrored, or both
`values`            other values of integers and choices, and which of them were searched
`change_value`      another value of an integer or a choice, held while all else adapts
`refine`            a narrow, patient search around a local optimum
`anew`              a new descent from a random place
`hypotheses`        where a learned model believes the answer to be
`modes`             how probable each of several answers is, by a learned model
`optima`            the distinct local optima
`choice`            a bandit that chooses among the moves
`status`            what is known of the run, in a sentence
==================  ===========================================================================
"""
