"""Runs a meshcat server on the loopback interface, as a process of its own.

meshcat's own server listens on every interface. This file imports nothing from vkc_pin, so that it
starts quickly.
"""

import base64
import os
import re
import sys
import threading
import urllib.parse
from typing import Any

import tornado.web
import tornado.websocket
import umsgpack  # type: ignore[import-untyped]
import zmq
from meshcat.servers.tree import find_node, walk
from meshcat.servers.zmqserver import ZMQWebSocketBridge

LOOPBACK = "127.0.0.1"
# [s] until a command gets an error for an answer
_PATIENCE = 5.0
# [bytes]
_MAX_MESSAGE = 2**28
# [bytes] of commands that wait for a page, besides the scene
_MAX_BACKLOG = 2**26
# [bytes] of commands that wait for all pages
_MAX_WAITING = 2**29
# [bytes] that a waiting command takes, as measured with tornado 6.6
_OVERHEAD = 2500
# of the tree of shown objects, which is walked recursively
_MAX_DEPTH = 50
_is_here = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?", re.IGNORECASE).fullmatch


class LoopbackBridge(ZMQWebSocketBridge):
    """A meshcat server bound to the loopback interface, which answers every message.

    Its socket takes no message before the last one is answered: an exception, or a page that never
    sends its image, would block it for ever.
    """

    _number = 0  # of the message that is handled
    _is_capturing = False

    def make_app(self):  # type: ignore[no-untyped-def]
        """Return a web application that listens on loopback and rejects other host names.

        Any web page could let its own host name resolve to this machine (DNS rebinding) and would
        then be accepted as the viewer. Requests with foreign host names are therefore refused.
        tornado refuses web sockets whose origin is not the requested host.
        """
        app = super().make_app()
        listen = app.listen
        find_handler = app.find_handler

        def listen_here(port, **options):  # type: ignore[no-untyped-def]
            options["address"] = LOOPBACK
            return listen(port, **options)

        def find_handler_here(request, **options):  # type: ignore[no-untyped-def]
            is_here = _is_here(request.headers.get("Host", ""))
            if is_here and "\0" not in urllib.parse.unquote(request.path):
                return find_handler(request, **options)
            refusal = {"status_code": 404 if is_here else 403}
            return app.get_handler_delegate(request, tornado.web.ErrorHandler, refusal)

        app.listen = listen_here
        app.find_handler = find_handler_here
        return app

    def setup_zmq(self, url):  # type: ignore[no-untyped-def]
        """Return the socket for commands, its stream, and its address."""
        self.context.setsockopt(zmq.MAXMSGSIZE, _MAX_MESSAGE)
        return super().setup_zmq(url)

    def handle_zmq(self, frames):  # type: ignore[no-untyped-def]
        """Carry out a command; invalid ones get an error for an answer."""
        self._number += 1
        self._is_capturing = False
        try:
            self.ioloop.call_later(_PATIENCE, self._give_up, self._number)
            if b"".join(frames[1:2]).count(b"/") > _MAX_DEPTH:
                raise ValueError("the path is too long")
            if frames[0] == b"capture_image":
                if len(frames) != 3 or not self.websocket_pool:
                    raise ValueError("expected 3 frames and an open page")
                self._is_capturing = True
            super().handle_zmq(frames)
            if frames[0] == b"set_property":
                self._forget_older_values(frames[1], umsgpack.unpackb(frames[2])["property"])
        except Exception as error:  # whatever a message contains, it must be answered
            self._answer(f"error: {error}".encode(errors="replace"))

    def send_image(self, data):  # type: ignore[no-untyped-def]
        """Answer with the image of a page, if one was asked for."""
        if self._is_capturing:
            self._is_capturing = False
            self._answer(base64.b64decode(data.partition(",")[2]))

    def _give_up(self, number: int) -> None:
        """Answer message `number` with an error, unless it was answered."""
        if number == self._number:
            self._answer(b"error: no answer in time")

    def _answer(self, data: bytes) -> None:
        """Send an answer, unless there is nothing to answer."""
        if self.zmq_socket.getsockopt(zmq.EVENTS) & zmq.POLLOUT:
            self.zmq_socket.send(data)
            # Messages that arrived before the answer do not wake the stream: ZeroMQ signals edges.
            self.ioloop.add_callback(self.zmq_stream.flush, zmq.POLLIN)

    def _forget_older_values(self, path: bytes, name: str) -> None:
        """Keep the last value of a property: meshcat keeps all, and sends them to new pages."""
        node = find_node(self.tree, [part for part in path.decode().split("/") if part])
        last = node.properties[-1]
        older = [data for data in node.properties if umsgpack.unpackb(data)["property"] != name]
        node.properties = [*older, last]

    def send_scene(self, page):  # type: ignore[no-untyped-def]
        """Send all that is shown to a new page."""
        page.waiting = 0
        for node in walk(self.tree):
            for part in (node.object, *node.properties, node.transform, node.animation):
                if part is not None:
                    self._send(page, part)
        page.most_waiting = page.waiting + _MAX_BACKLOG

    def forward_to_websockets(self, frames):  # type: ignore[no-untyped-def]
        """Send a command to all open pages; skip closed ones, so that the sender gets an answer.

        Pages that do not read, as in a suspended browser, are disconnected: what waits for them
        would fill the memory. A page that has read everything gets commands of any size.
        """
        pages = [page for page in self.websocket_pool if page.ws_connection is not None]
        pages.sort(key=lambda page: page.waiting)
        total = sum(page.waiting for page in pages)
        while pages and (pages[-1].waiting > pages[-1].most_waiting or total > _MAX_WAITING):
            slowest = pages.pop()
            total -= slowest.waiting
            slowest.ws_connection.stream.close()
        for page in pages:
            self._send(page, frames[2])

    def _send(self, page, data: bytes) -> None:  # type: ignore[no-untyped-def]
        """Send data to a page, and count them until they are sent."""
        size = len(data) + _OVERHEAD

        def forget(sent: Any) -> None:
            page.waiting -= size
            sent.exception()  # of closed pages: asyncio would log each that nobody looks at

        page.waiting += size
        try:
            page.write_message(data, binary=True).add_done_callback(forget)
        except tornado.websocket.WebSocketClosedError:
            page.waiting -= size


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
