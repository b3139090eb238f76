"""Bayesian optimization in a trust region: of the loss (`turbo`) and of the image (`composite`).

Every round (Eriksson et al. 2019, "Scalable global optimization via local Bayesian optimization")

1. Gaussian processes are fitted to what was evaluated since the last start.
2. Candidates are Sobol points in a box around the best point, whose sides are proportional to the
   lengthscales of the processes; each candidate changes some 20 of the parameters.
3. Thompson sampling: the processes are drawn `popsize` times, jointly at all candidates, and the
   best candidate of each draw is evaluated.
4. The box doubles after three rounds with progress and halves after some without.  When it has
   become small, all is forgotten and the search begins anew.

The processes, the draws and the quasi-random points are those of BoTorch and GPyTorch:
pip install botorch.
"""
