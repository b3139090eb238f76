"""One optimizer in many processes."""
