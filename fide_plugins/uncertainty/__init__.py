"""How sure parameters are: by renders around the answer of a fit, elsewhere by samples."""
