"""What a run records, and its directory: of the run loop, and of `fit`.

===============  ============================================================
`record`         history, progress and results of a run
`record_schema`  schema of the history in a checkpoint
`outcome`        the result, from record and noise-free evaluation
`directory`      files of the run directory
`kept_target`    the target to the last bit, for who goes on
`sources`        files of the user on which a run depends
`tables`         its two tables, as text
`checkpointing`  when to write the next checkpoint; each file where one fails
`signals`        Ctrl-C and SIGTERM
`parallel`       rounds that parallel renderers would need
`figures`        PNG files: images, film frames, summary.png
===============  ============================================================
"""
