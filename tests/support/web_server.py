"""A web server that understands ranges, or does not, counts what it sends, and can break off or fail."""

import http.server
import re
import threading
from contextlib import contextmanager


class Site:
    """Files to serve by their path.

    has_ranges : whether it honors Range; etag : what it calls their version
    failures : statuses of the next GET answers, 0 for one that breaks off in the middle
    cuts : numbers of bytes after which the next answers break off
    asked : the ranges asked for, None for the whole; sent : bytes of bodies
    """

    def __init__(self, files):
        self.files = files
        self.has_ranges, self.etag = True, '"one"'
        self.failures, self.cuts, self.asked = [], [], []
        self.sent = 0
        self.lock = threading.Lock()

    def answer(self, handler, *, is_head):
        body = self.files.get(handler.path)
        if body is None:
            return handler.send_error(404)
        with self.lock:
            failure = self.failures.pop(0) if self.failures and not is_head else None
        if failure:
            return handler.send_error(failure)
        wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", handler.headers.get("Range") or "")
        begin, end = 0, len(body)
        if wanted and self.has_ranges:
            begin, end = int(wanted[1]), min(int(wanted[2] or end) + 1, end)
            if begin >= len(body):
                return handler.send_error(416)
            handler.send_response(206)
            handler.send_header("Content-Range", f"bytes {begin}-{end - 1}/{len(body)}")
        else:
            handler.send_response(200)
        handler.send_header("ETag", self.etag)
        handler.send_header("Content-Length", str(end - begin))
        handler.end_headers()
        if is_head:
            return None
        with self.lock:
            cut = begin + self.cuts.pop(0) if self.cuts else end
            part = body[begin : (begin + end) // 2 if failure == 0 else cut]
            self.asked.append(handler.headers.get("Range"))
            self.sent += len(part)
        handler.wfile.write(part)
        handler.close_connection = True
        return None


@contextmanager
def serving(files):
    """A site on this machine; ``site.url`` is its address."""
    site = Site(files)

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            site.answer(self, is_head=False)

        def do_HEAD(self):
            site.answer(self, is_head=True)

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    site.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
