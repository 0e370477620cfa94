"""A meshcat server that only this machine can reach; started as a process of its own by `visualization`.

meshcat's own serves its web page to every interface. This file imports nothing of vkc_pin, so that it starts quickly.
"""

import os
import sys
import threading

from meshcat.servers.zmqserver import ZMQWebSocketBridge

LOOPBACK = "127.0.0.1"


class LoopbackBridge(ZMQWebSocketBridge):
    """A meshcat server bound to the loopback interface."""

    def make_app(self):  # type: ignore[no-untyped-def]
        """Return the web application, listening on the loopback interface only."""
        app = super().make_app()
        listen = app.listen
        app.listen = lambda port, **options: listen(port, **{**options, "address": LOOPBACK})
        return app


def _end_with_parent() -> None:
    """End when the process that started this one does: its end of our standard input closes."""
    sys.stdin.buffer.read()
    os._exit(0)


def main() -> None:
    """Serve until standard input closes; say where, in two lines."""
    bridge = LoopbackBridge(host=LOOPBACK)
    sys.stdout.write(f"zmq_url={bridge.zmq_url}\nweb_url={bridge.web_url}\n")
    sys.stdout.flush()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    bridge.run()


if __name__ == "__main__":
    main()
