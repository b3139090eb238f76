"""The machine: devices, threads, files, time.

======================  =========================================================================
`devices`               which device computes; copies to it
`batch_size`            batch sizes that shrink if a device runs out of memory
`fixed_batches`         networks in batches of a fixed size
`digest`                which weights a network has, in a few digits
`fingerprints`          whether a file, a function or a renderer of the user has changed
`background`            work in a background thread
`locks`                 locks for objects that are copied, pickled and forked
`threads`               one thread for what is small, those of the user for networks
`machine`               versions and hardware
`timing`                seconds by part
`cluster`               a Dask cluster by the address of its scheduler
`extras`                what each extra installs, and the error where it is missing
`laboratory`            the only place that looks for `fide_lab`, and loads of it by name
`files`                 atomic writes and file locks
`checkpoint`            file format of a state, without pickle
`schema`                checks of a state that was read from a file
`registry`              factories by name
`reference`             an attribute of a user's file or module: ``FILE.py:NAME``, ``module:NAME``
`warn`                  warnings that name the line of the user
`callables`             tries a user's function of images
`wording`               words of messages
`opencv`                OpenCV, or what to do where its installation is broken
`opencv_distributions`  which distributions of OpenCV are installed
======================  =========================================================================
"""
