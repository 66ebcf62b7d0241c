"""How a peer is driven: one JSON request a line on standard input, one answer a line on standard output."""

import json
import sys


def serve(peer: object) -> None:
    """Answers requests by the peer's methods until it is asked to quit."""
    # Libraries print as they like; answers keep standard output to themselves.
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        request = json.loads(line)
        command = request.pop("cmd")
        if command == "quit":
            return
        print(json.dumps(getattr(peer, command)(**request)), file=answers, flush=True)
