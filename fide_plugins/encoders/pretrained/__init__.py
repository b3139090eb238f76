"""Encoders with pretrained networks.

==============  ==============================================================
`network`       base class: batches of fixed size, cache, color normalization
`dinov3`        encoder `dinov3`: DINOv3 and DINOv2 vision transformers
`dino_files`    files of a DINO network
`efficientnet`  encoder `efficientnet`: a stage of EfficientNet-Lite0
`vgg19`         encoder `vgg19`: a layer of VGG-19
`backbones`     convolutional parts of AlexNet, VGG and SqueezeNet
`weights`       finds, reads and checks files of weights
==============  ==============================================================
"""
