"""The machine: devices, threads, files, and what users name or hand over.

============  ====================================================================================
`devices`     which device computes, batches that fit its memory, digests of networks
`threads`     how many threads compute; locks; what a fork leaves of them
`machine`     hardware, time, and what is installed: extras, OpenCV; a Dask cluster
`laboratory`  the only place that looks for `fide_lab`, and loads of it by name
`files`       atomic writes, files that may be anybody's, and file locks
`checkpoint`  file format of a state, without pickle
`schema`      checks of a state that was read from a file
`registry`    factories by name, attributes of users' files, fingerprints of their renderers
`messages`    words of messages, warnings that name the line of the user
`opencv`      OpenCV, or what to do where its installation is broken
`plotting`    figures of matplotlib, or what to install
============  ====================================================================================
"""
