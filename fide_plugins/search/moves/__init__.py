"""Where to go on when a search has stalled: a family of moves, chosen by what they brought.

A loss of images has many local optima that no small step leaves: two cells stand for one of the
target's and one for two, a wrist is turned around, a layer is painted too early. A local optimum is
mostly right, so a move keeps most of it. What moves have to know of the scene is in `search.scene`.

==================  ================================================================================
file                idea
==================  ================================================================================
`policy`            what the next generation is for: `MovePolicy`, through which all moves are used
`policy_schema`     what a saved state of it must be like
`choice`            a bandit that chooses among the moves
`base`              what a move is, and what all moves know
`split`             a redundant block becomes a copy of one that has too much to do
`relocate_group`    a parameter group at a random place
`relocate_segment`  a segment of neighboring parameters at a random place
`swap`              two groups with their values exchanged
`crossover`         a segment of parameters from another local optimum
`half_turn`         angles that look alike: half a turn away, mirrored, or both
`change_value`      another value of an integer or a choice, held while all else adapts
`refine`            a narrow, patient search around a local optimum
`anew`              a new search from a random place
`hypotheses`        where a learned model believes the answer to be
`resample`          what a learned model leaves open, drawn again around the best so far
==================  ================================================================================
"""
