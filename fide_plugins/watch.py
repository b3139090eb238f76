"""Old name of `fide_lab.watch`."""

from fide_plugins.runtime.laboratory import keep_old_name

keep_old_name(__name__, "fide_lab.watch")
