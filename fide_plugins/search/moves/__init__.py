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
`groups`            parameter groups: one at a random place, two exchanged, one split in two
`segments`          neighboring parameters: at a random place, from another optimum, angles turned
`change_value`      another value of an integer or a choice, held while all else adapts
`restarts`          a new search from a random place; a narrow one around a local optimum
`hypotheses`        where a learned model believes the answer to be, and what it leaves open
==================  ================================================================================
"""
