"""What a run records, and its directory: of the run loop, and of `fit`.

===============  ============================================================
`record`         history, progress and results of a run
`record_schema`  schema of the history in a checkpoint
`outcome`        the result, from record and noise-free evaluation
`directory`      the run directory, as a run writes it
`json_record`    the record of a run or a comparison, as others read it
`run_checkpoint` the state from which a run goes on, as others read it
`kept_target`    the target to the last bit, for who goes on
`sources`        files of the user on which a run depends
`tables`         its two tables, as text
`checkpointing`  when to write the next checkpoint; each file where one fails
`signals`        Ctrl-C and SIGTERM
`parameters`     values of parameters in their units, and how sure they are
`kept_solutions` solutions of a fit in the record
`parallel`       rounds that parallel renderers would need
`figures`        PNG files: images, film frames, summary.png
`result_figure`  what `Result.plot` draws
`pairs_figure`   what `Result.plot_pairs` draws
`drawn`          parameters as numbers on axes
===============  ============================================================
"""
