"""Pretrained networks: encoders `dinov3`, `efficientnet`, `vgg19`, the loss `lpips`; weights."""
