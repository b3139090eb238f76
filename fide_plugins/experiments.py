"""Old name of `fide_lab`."""

from fide_plugins.runtime.laboratory import keep_old_name

keep_old_name(__name__)
keep_old_name(f"{__name__}.solutions", "fide_lab.solutions")
