"""Who may look: a page of ours in a browser on this machine, and nobody's else.

A web page from anywhere may make its reader's browser ask 127.0.0.1 for things. Two checks keep
such pages out. The Host header must name this machine: a page whose own name was made to resolve to
127.0.0.1 (DNS rebinding) still asks for its name. And a socket's Origin must be this very server.
"""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

PAGE_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Go with every answer: nothing from elsewhere is loaded, and no other page can hold ours."""


def is_our_name(host: str, served_as: str) -> bool:
    """Whether a Host header may be that of our page: localhost, an address, or `served_as`.

    Any port will do, since `ssh -L` may bring the page to another one.
    """
    try:
        name = urlsplit(f"//{host}").hostname
        if not name:
            return False
        if name in {"localhost", served_as.lower()}:
            return True
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_our_page(origin: str | None, host: str) -> bool:
    """Whether a socket's Origin is the page that this server served; programs send none."""
    return origin is None or origin == f"http://{host}"


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
