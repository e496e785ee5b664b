"""Only the window's own page may talk to it: other pages in the same browser can reach this machine's ports too."""

import contextlib
import http
import ipaddress
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit


@contextlib.contextmanager
def only_own_pages(host: str) -> Iterator[None]:
    """A server of websockets that is started in here refuses what `is_own` does."""
    from websockets.asyncio import server

    serve = server.serve

    def guarded(*arguments: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if not is_own(request.headers, host):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "rodjax answers its own page only\n")
            return process_request(connection, request)

        return serve(*arguments, process_request=checked, **options)

    server.serve = guarded
    try:
        yield
    finally:
        server.serve = serve


def is_own(headers: Mapping[str, str], host: str) -> bool:
    """Whether a request to a server at `host` is by the page that it serves, or by no page.

    A page of another origin says so in `Origin`. One whose name was made to lead to this machine shows by its `Host`:
    a server that only this machine reaches has no other names than those of this machine.
    """
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    try:
        name = urlsplit(f"//{asked}").hostname or ""
        if origin is not None and urlsplit(origin).netloc != asked:
            return False
    except ValueError:
        return False
    return name == host.lower() or _is_of_this_machine(name) or not _is_of_this_machine(host)


def _is_of_this_machine(name: str) -> bool:
    if name == "localhost" or name.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
