"""A trial: FIDE with a diagonal covariance.

python benchmarks/diagonal.py sep 30 5000 200,201,202
python benchmarks/diagonal.py full 30 5000 200,201,202
"""

import sys, time, numpy as np, fide_tasks
from fide_plugins import FIDE
from fide_plugins.search import cma_es


def patch():
    C = cma_es.CMAES
    old = C._set_weights

    def set_weights(self, d, k):
        old(self, d, k)
        f = (d + 2) / 3
        self._c_1 = min(1, self._c_1 * f)
        self._c_mu = min(1 - self._c_1, self._c_mu * f)
        raw = np.log((k + 1) / 2) - np.log(np.arange(1, k + 1))
        pos = raw[: k // 2].sum()
        self._weights = np.where(raw >= 0, raw / pos, 0.0)
        self._decompose_every = 1

    def update(self, y, lengths, long_path):
        w = self._weights
        pause = self._c_c * (2 - self._c_c) if long_path else 0.0
        keep = 1 + self._c_1 * pause - self._c_1 - self._c_mu * w.sum()
        diag = keep * np.diag(self.C) + self._c_1 * self.p_c**2 + self._c_mu * (w @ y**2)
        self.C = np.diag(diag)

    def decompose(self):
        d = np.diag(self.C)
        self._B = np.eye(len(d))
        self._D = np.sqrt(d)

    C._set_weights, C._update_covariance, C._decompose = set_weights, update, decompose


if sys.argv[1] == "sep":
    patch()
scene, opts = (
    ("triangles", {"triangles": int(sys.argv[2])})
    if sys.argv[2] != "v"
    else ("voronoi", {"cells": 32})
)
for seed in map(int, sys.argv[4].split(",")):
    t = fide_tasks.make(scene, 64, seed, **opts)
    opt = FIDE(t.dim, t.target, seed=0)
    marks = []
    c = time.process_time()
    while opt.evaluations < int(sys.argv[3]):
        X = opt.ask_ready()
        opt.tell(X, t.render(X))
        if opt.evaluations // 1000 > len(marks):
            marks.append(round(opt.best.loss, 4))
    print(sys.argv[1], sys.argv[2], seed, marks, f"cpu {time.process_time() - c:.0f}", flush=True)
