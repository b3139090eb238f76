"""A network is trained on renders.

==============  ===================================================================================
file            idea
==============  ===================================================================================
`one_training`  of network or emulator, judged on held-out renders
`resumable`     training that goes on from its checkpoint
`augmentation`  what separates a picture from a render
==============  ===================================================================================
"""
