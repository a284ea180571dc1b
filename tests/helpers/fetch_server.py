"""A server of one published archive that cuts, lies and refuses as it is told to."""

import contextlib
import http.server
import io
import re
import tarfile
import threading

NAME = "tum/fr3/sitting_static"
FOLDER = "rgbd_dataset_freiburg3_sitting_static"
"""The archive that is served: its id, and the folder inside."""


class Server:
    """Serves one file; `plan` holds what goes wrong with each of the next requests."""

    def __init__(self, data):
        self.data = data
        self.plan = []
        self.requests = []
        self.etag = '"one"'
        self.ranges = True
        owner = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *args):
                pass

            def do_GET(self):
                owner.requests.append(self.headers.get("Range"))
                owner.answer(self, owner.plan.pop(0) if owner.plan else {})

        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.http.serve_forever, args=(0.02,), daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}/{FOLDER}.tgz"

    def answer(self, handler, fault):
        handler.close_connection = True
        if "status" in fault:
            handler.send_error(fault["status"])
            return
        wanted = re.fullmatch(r"bytes=(\d+)-", handler.headers.get("Range") or "")
        resumed = wanted and self.ranges and handler.headers.get("If-Range", self.etag) == self.etag
        start = int(wanted[1]) if resumed else 0
        size = len(self.data)
        headers = {"ETag": self.etag}
        body = self.data[start:]
        status = 416 if start >= size else 206 if start else 200
        if start:
            headers["Content-Range"] = f"bytes {f'{start}-{size - 1}' if body else '*'}/{size}"
        sent = body[: fault.get("cut", size)]
        if fault.get("chunked"):
            headers["Transfer-Encoding"] = "chunked"
            half = len(body) // 2
            first, rest = (
                b"%x\r\n" % len(part) + part + b"\r\n" for part in (body[:half], body[half:])
            )
            sent = first + rest + b"0\r\n\r\n" if fault["chunked"] == "whole" else first
        else:
            headers["Content-Length"] = str(len(body) + fault.get("lie", 0))
        handler.send_response(status)
        for name, value in headers.items():
            handler.send_header(name, value)
        handler.end_headers()
        with contextlib.suppress(ConnectionError):
            handler.wfile.write(sent)

    def close(self):
        self.http.shutdown()
        self.http.server_close()


def tgz(folder, name=FOLDER, extra=()):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", compresslevel=0) as tar:
        tar.add(folder, arcname=name)
        for info, data in extra:
            tar.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


def left_behind(root):
    """Every file below the root, hidden ones included, but for the checksums that are kept of archives."""
    kept = {*root.glob(".downloads/*.sha256")}
    return sorted(
        path.relative_to(root).as_posix()
        for path in root.rglob("*")
        if path.is_file() and path not in kept
    )
