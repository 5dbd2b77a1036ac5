"""A store in object storage.

Requests are repeated here and not by obstore, which gives up (in version 0.12.1) where an answer breaks off in its
middle, and where one that creates an object is lost.
"""

from __future__ import annotations

import os
import random
import re
import time
from collections.abc import Callable, Mapping
from datetime import timedelta
from functools import cache, cached_property
from typing import Any, TypeVar
from urllib.parse import urlsplit

from lieint_jax.runs._storage.storage import Storage, Url

_T = TypeVar("_T")
_SECRET = re.compile("SECRET|TOKEN|PASSWORD|ACCESS_KEY|ACCOUNT_KEY|CREDENTIAL|SAS")  # in the names of variables
_FIRST_DELAY, _LONGEST_DELAY = 0.1, 20.0  # seconds before the first retry of a request, and at most before another
_FIRST_PATIENCE, _PATIENCE = 30.0, 600.0  # seconds of retries: of the first request, for a wrong address; of others
_TIMEOUT = 60.0  # seconds without an answer after which a request has failed


class Bucket(Storage):
    """Objects below a prefix in a bucket, by `obstore`. Every request that fails is repeated, with backoff."""

    is_remote = True

    def __init__(self, url: Url) -> None:
        self.address = self._url = url
        self._reached = False  # whether a request has succeeded

    @cached_property
    def _store(self) -> Any:
        """The bucket; the environment holds its credentials, region and endpoint, in the names of its provider."""
        try:
            import obstore.store
        except ImportError:
            raise ValueError(
                f"{self.address} is in object storage, which needs obstore: pip install 'lieint_jax[cloud]'"
            ) from None
        if urlsplit(self._url).scheme == "memory":
            return _memory(self._url)
        options = {"timeout": timedelta(seconds=_TIMEOUT), "allow_http": _allows_http()}
        no_retry = {"max_retries": 0, "retry_timeout": timedelta(seconds=2 * _TIMEOUT)}  # `_retry` repeats requests
        try:
            return obstore.store.from_url(self._url, client_options=options, retry_config=no_retry)  # pyright: ignore
        except Exception as error:
            raise ValueError(f"{self.address} cannot be opened: {message(error)}") from None

    def read(self, name: str) -> bytes:
        """See `Storage`."""
        return self._retry(name, lambda obs: obs.get(self._store, name).bytes().to_bytes())

    def tail(self, name: str) -> bytes:
        """See `Storage`."""
        last = {"range": {"suffix": 4}}
        return self._retry(name, lambda obs: obs.get(self._store, name, options=last).bytes().to_bytes())

    def stage(self, name: str, data: bytes) -> None:
        """See `Storage`."""
        try:
            self._retry(name, lambda obs: obs.put(self._store, name, data))
        except FileNotFoundError:
            raise OSError(f"{self.address} cannot be written: there is no such bucket") from None

    def create_store(self, root: str, files: Mapping[str, bytes]) -> bool:
        """See `Storage`. If an answer was lost, the repeated request finds the object that the first has created."""
        import obstore.exceptions

        try:
            self._retry(root, lambda obs: obs.put(self._store, root, files[root], mode="create"))
        except (obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError):
            return self.read(root) == files[root]
        return True

    def sizes(self, folder: str = "") -> dict[str, int]:
        """See `Storage`."""

        def listed(obs: Any) -> dict[str, int]:
            batches = obs.list(self._store, folder or None)
            return {entry["path"]: entry["size"] for batch in batches for entry in batch}

        return self._retry(folder, listed)

    def _retry(self, name: str, request: Callable[[Any], _T]) -> _T:
        """The result of a request, which is repeated while it fails for a reason that may pass."""
        import obstore
        from obstore import exceptions

        _ = self._store  # a ValueError of its own if there is none
        final = (exceptions.AlreadyExistsError, exceptions.PreconditionError)
        refused = (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError)
        wrong = (exceptions.NotSupportedError, exceptions.InvalidPathError, exceptions.UnknownConfigurationKeyError)
        start, delay = time.monotonic(), _FIRST_DELAY
        while True:
            try:
                result = request(obstore)
            except FileNotFoundError:
                self._reached = True
                raise FileNotFoundError(f"{self.address} has no object {name}") from None
            except final:
                raise
            except (*refused, *wrong) as error:
                raise PermissionError(f"{self.address} refuses the request: {message(error)}") from None
            except (exceptions.BaseError, OSError, TimeoutError) as error:
                if time.monotonic() - start > (_PATIENCE if self._reached else _FIRST_PATIENCE):
                    raise OSError(f"{self.address} cannot be reached: {message(error)}") from None
                time.sleep(delay * random.uniform(0.5, 1.0))  # so that the clients of a busy server do not beat in time
                delay = min(2 * delay, _LONGEST_DELAY)
                continue
            self._reached = True
            return result


def message(error: BaseException) -> str:
    """The first line of an error's message, without anything that the environment holds as a secret."""
    [line, *_] = str(error).splitlines() or [""]
    line = re.sub(r"\?\S+", "?…", re.sub(r"<\?xml.*", "", line)).strip().rstrip(":")
    for key, value in os.environ.items():
        if _SECRET.search(key.upper()) and len(value) > 3:
            line = line.replace(value, "…")
    return f"{type(error).__name__}: {line}" if line else type(error).__name__


@cache
def _memory(url: str) -> Any:
    """The objects in this process' memory at a URL memory://…"""
    from obstore.store import MemoryStore

    return MemoryStore()


def _allows_http() -> bool:
    """True if requests may be sent without encryption: the user has given an endpoint http://…, or allows it."""
    endpoints = [os.environ.get(key, "") for key in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT", "AWS_ENDPOINT_URL_S3")]
    allowed = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")
    return allowed or any(endpoint.startswith("http://") for endpoint in endpoints)
