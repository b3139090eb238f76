"""A trained network is calibrated, and measured on renders that it has not seen.

=============  ====================================================================================
file           idea
=============  ====================================================================================
`finishing`    calibration, then the report
`calibration`  one scale for all standard deviations of a density
`report`       how good a model is: likelihood, hypotheses, calibration
`seen`         which parameters images show
`familiarity`  how much a picture is like those that were learned
=============  ====================================================================================
"""
