"""Runs a meshcat server on the loopback interface, as a process of its own.

meshcat's own server listens on every interface. This file imports nothing from vkc_pin, so that it
starts quickly.
"""

import contextlib
import os
import re
import sys
import threading

import tornado.web
import tornado.websocket
from meshcat.servers.zmqserver import ZMQWebSocketBridge

LOOPBACK = "127.0.0.1"
_is_here = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?", re.IGNORECASE).fullmatch


class LoopbackBridge(ZMQWebSocketBridge):
    """A meshcat server bound to the loopback interface."""

    def make_app(self):  # type: ignore[no-untyped-def]
        """Return a web application that listens on loopback and rejects other host names.

        Any web page could let its own host name resolve to this machine (DNS rebinding) and would
        then be accepted as the viewer. Requests with foreign host names are therefore refused.
        tornado refuses web sockets whose origin is not the requested host.
        """
        app = super().make_app()
        listen, find = app.listen, app.find_handler

        def find_here(request, **options):  # type: ignore[no-untyped-def]
            if _is_here(request.headers.get("Host", "")):
                return find(request, **options)
            return app.get_handler_delegate(request, tornado.web.ErrorHandler, {"status_code": 403})

        app.listen = lambda port, **options: listen(port, **{**options, "address": LOOPBACK})
        app.find_handler = find_here
        return app

    def forward_to_websockets(self, frames):  # type: ignore[no-untyped-def]
        """Send a command to all open pages; skip closed ones, so that the sender gets an answer."""
        for page in tuple(self.websocket_pool):
            with contextlib.suppress(tornado.websocket.WebSocketClosedError):
                page.write_message(frames[2], binary=True)


def _end_with_parent() -> None:
    """Exit with the parent process, which closes standard input."""
    sys.stdin.buffer.read()
    os._exit(0)


def main() -> None:
    """Serve until standard input closes; print the two addresses."""
    bridge = LoopbackBridge(host=LOOPBACK)
    sys.stdout.write(f"zmq_url={bridge.zmq_url}\nweb_url={bridge.web_url}\n")
    sys.stdout.flush()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    bridge.run()


if __name__ == "__main__":
    main()
