"""From a picture to a density of the parameters, and from exchangeable blocks to a picture.

=============  ====================================================================================
file           idea
=============  ====================================================================================
`trainable`    what a network needs to be trained
`network`      encoder and head
`encoder`      a small convolutional network
`heads`        densities of the parameters: autoregressive, mixture
`sets`         exchangeable blocks as a set
`head_choice`  which head, which blocks are exchangeable, whether there is an emulator
`axes`         densities on one axis: truncated and wrapped Gaussians
`emulator`     a learned renderer of exchangeable blocks
`attention`    of emulator and sets
`inversion`    parameters of a picture, by descents through the emulator
=============  ====================================================================================
"""
