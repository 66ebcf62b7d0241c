"""Runs moto's S3 server on a free loopback port for as long as standard input stays open.

The port is printed on standard output. Exit status 3 says that moto is not installed.
"""

import io
import logging
import os
import sys
import threading

try:
    from moto.moto_server.werkzeug_app import (
        DomainDispatcherApplication,
        create_backend_app,
    )
    from werkzeug.serving import make_server
except ImportError as error:
    print(error, file=sys.stderr)
    sys.exit(3)

logging.getLogger("werkzeug").setLevel(logging.ERROR)
dispatch = DomainDispatcherApplication(create_backend_app)
writing = threading.Lock()


def app(environ, start_response):
    """Lets one write in at a time.

    moto tests If-Match and If-None-Match first and stores the object later, so two threads could
    both create an object that was absent. S3 and GCS promise that only one of them does.
    """
    if environ["REQUEST_METHOD"] in ("GET", "HEAD"):
        return dispatch(environ, start_response)
    # The body is read before the lock is taken, so that a stalled client does not stall the rest.
    length = int(environ.get("CONTENT_LENGTH") or 0)
    environ["wsgi.input"] = io.BytesIO(environ["wsgi.input"].read(length))
    with writing:
        return dispatch(environ, start_response)


def exit_with_parent():
    """The kernel closes the pipe when the parent ends, however it ends."""
    sys.stdin.buffer.read()
    os._exit(0)


server = make_server("127.0.0.1", 0, app, threaded=True)
threading.Thread(target=exit_with_parent, daemon=True).start()
print(server.server_port, flush=True)
server.serve_forever()
