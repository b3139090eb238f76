"""One call that fits: workers, failures, checkpoints, callbacks and a result.

Nothing is imported here: worker processes load `rendering`, and no PyTorch.
"""
