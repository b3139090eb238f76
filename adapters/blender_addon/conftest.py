"""What lies here runs in Blender; `tests/adapters/blender` tests it there."""

collect_ignore_glob = ["fide_fit/*"]
