"""A page that shows a run while it goes on: target, best image, difference, curve, parameters.

    server, url = serve("runs/mine")     # answers in a background thread of its own
    fit(..., out="runs/mine", callbacks=[LiveFile()])
    server.close()

`serve` reads a run directory, of `fide run` or of `fit`, so it can also run in another process
(`fide watch DIR`).  It listens on 127.0.0.1 alone, answers GET only, and knows a fixed list of
names: the page, its data, and three pictures of that run.  It writes nothing and executes nothing.

=============  ==================================================================
`server`       the server, and what it refuses
`snapshot`     what is known of a run, from its files
`live`         a callback of `fit` that writes `live.json` twice a second at most
`page/`        the page: HTML, CSS, JavaScript, without anything from elsewhere
=============  ==================================================================
"""

from __future__ import annotations

from fide_plugins.watch.live import LiveFile
from fide_plugins.watch.server import Server, serve

__all__ = ["LiveFile", "Server", "serve"]
