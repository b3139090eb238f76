"""What a run records, and its directory: of the runs of the lab, and of `fit`.

===============  ============================================================
`record`         history, progress and results of a run
`directory`      the run directory, as a run writes it, and when
`storage`        its files, as others read them
`sources`        files of the user on which a run depends
`signals`        Ctrl-C and SIGTERM
`parameters`     values of parameters in their units, and how sure they are
`figures`        PNG files: images, summary.png
`plots`          what `Result.plot` and `Result.plot_pairs` draw
===============  ============================================================
"""
