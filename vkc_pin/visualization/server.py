"""A meshcat server that only this machine can reach; started as a process of its own by `visualization`.

meshcat's own serves its web page to every interface. This file imports nothing of vkc_pin, so that
it starts quickly.
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
        """Return the web application, listening on the loopback interface only, to browsers that mean this machine.

        Any page can have its own name lead to this machine, and would then be let in as the
        viewer's own. So a name that is not this machine's is refused; tornado refuses web sockets
        of pages from anywhere else than the name that was asked for.
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
        """Send a command to every page that is still there: one that was just closed would leave the sender without an answer."""
        for page in tuple(self.websocket_pool):
            with contextlib.suppress(tornado.websocket.WebSocketClosedError):
                page.write_message(frames[2], binary=True)


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
