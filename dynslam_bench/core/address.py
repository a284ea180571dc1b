"""Which web addresses are fetched from: https, or http where the content is checked, and nothing they redirect to else.

The address itself is data, too: it comes from catalogues, from users and from servers' redirects.
"""

from __future__ import annotations

import ipaddress
import urllib.request
from typing import IO, Any
from urllib.parse import SplitResult, urlsplit

from .errors import DownloadError


def check_address(url: str, *, checked: bool) -> SplitResult:
    """The parts of an address that may be fetched.

    Args:
        url: The address.
        checked: Whether a checksum of the content is known; then plain http will do, and on this machine always.

    Raises:
        DownloadError: Another scheme, no host, characters that no address has, or a password.
    """
    try:
        parts = urlsplit(url)
        host, port = (parts.hostname or "").encode("idna").decode(), parts.port
    except ValueError as error:
        raise DownloadError(f"cannot download {url[:200]!r}: {error}") from error
    if parts.scheme not in ("http", "https"):
        raise DownloadError(f"cannot download {url[:200]!r}", "the address has to begin with http:// or https://")
    if not host or port == 0 or not url.isascii() or not url.isprintable() or " " in url:
        raise DownloadError(f"cannot download {url[:200]!r}: it is no web address", "for example https://host/name.tgz")
    if parts.username is not None or parts.password is not None:
        raise DownloadError(f"cannot download from {host}: the address holds a name or password", "leave them out")
    if parts.scheme == "http" and not checked and not _is_here(host):
        raise DownloadError(
            f"cannot download {url[:200]!r}: http without a known checksum could bring anything", "use https"
        )
    return parts


def connect(request: urllib.request.Request, timeout_s: float) -> Any:
    """As the standard library opens an address, for http and https alone, whatever a server redirects to.

    Raises:
        DownloadError: The server redirects to another scheme.
        OSError: It cannot be reached, or answers with an error.
    """
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler,
        urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        _Redirect,
    ):
        opener.add_handler(handler())
    return opener.open(request, timeout=timeout_s)


class _Redirect(urllib.request.HTTPRedirectHandler):
    """Follows redirects to https, and from http to http."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        scheme = urlsplit(newurl).scheme
        if scheme != "https" and scheme != req.type:
            raise DownloadError(f"the server redirects {req.full_url} to {newurl[:200]!r}, refused", "name a mirror")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _is_here(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
