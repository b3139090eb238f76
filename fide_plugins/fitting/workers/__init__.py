"""Where renders happen: in this process, in processes that can be killed, or in any executor.

=============  =================================================================
`base`         what a set of workers is
`here`         this process, one render after the other
`processes`    processes of our own, each killed and replaced by itself
`executors`    threads, any executor of `concurrent.futures`, Dask
`threads`      threads that do not keep the process alive where a render hangs
`choice`       which of them `fit` takes
`gather`       renders outside of the loop of a fit
=============  =================================================================
"""
