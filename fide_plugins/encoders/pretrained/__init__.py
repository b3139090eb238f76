"""Encoders with pretrained networks: `dinov3`, `efficientnet`, `vgg19`; their base and weights."""
