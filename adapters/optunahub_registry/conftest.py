"""What lies here is run where it is published; `tests/adapters/optuna/test_hub.py` tests it here."""

collect_ignore_glob = ["package/*"]
