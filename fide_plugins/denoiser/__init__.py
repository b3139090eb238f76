"""The conditional denoiser of the paper: it estimates the parameters that made an image."""
