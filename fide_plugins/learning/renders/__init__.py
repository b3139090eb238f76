"""Renders of random parameters: what makes them, where they are kept, whether they can be used.

===========  ======================================================================================
file         idea
===========  ======================================================================================
`renderer`   a user's function, or a task
`store`      renders on disk, in shards
`identity`   whether what renders now is what rendered before
`tally`      whether what was rendered can be learned from
`rendering`  fills the store, in one process or several, or on a cluster
===========  ======================================================================================
"""
