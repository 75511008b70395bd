"""S3 and compatible object stores: s3fs with bounded retries, errors that say what to do, and conditional writes.

fsspec opens every `s3://` URI with this class once `tableverse_factory.core.storage.files` is imported, so that
captures, the manifest and OUT behave alike. Credentials and endpoint come from the AWS environment variables and files.
"""

import asyncio
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any

from aiohttp import ClientError as TransferError
from botocore.exceptions import (
    BotoCoreError,
    ClientError,
    NoCredentialsError,
    PartialCredentialsError,
    ProfileNotFound,
    TokenRetrievalError,
)
from fsspec.asyn import sync_wrapper
from s3fs import S3FileSystem

from tableverse_factory.core.errors import StoreError

_ATTEMPTS = 5
_MAX_DELETED = 1000
_FENCE_POLL_S = 0.5
_CONDITION_CODES = ("PreconditionFailed", "ConditionalRequestConflict", "412", "409")
_REFUSED_CODES = (
    *("AccessDenied", "AllAccessDisabled", "ExpiredToken", "InvalidAccessKeyId", "InvalidToken"),
    *("SignatureDoesNotMatch", "RequestTimeTooSkewed", "Forbidden", "401", "403"),
)
_CREDENTIAL_ERRORS = (NoCredentialsError, PartialCredentialsError, ProfileNotFound, TokenRetrievalError)
_FOREIGN_ERRORS = (BotoCoreError, ClientError, TransferError, OSError)


class PreconditionFailedError(StoreError):
    """A conditional write found another version of the object than it named."""

    topic = "one-writer"


@dataclass(frozen=True, slots=True)
class VersionedObject:
    """A small object, its etag for conditional writes, and its age by the clock of the store alone [s]."""

    data: bytes
    etag: str
    age_s: float


class ObjectStore(S3FileSystem):  # type: ignore[misc]
    """An s3fs file system whose failures are `StoreError`; a missing key stays a FileNotFoundError."""

    retries = 2  # of s3fs, for bodies that are cut off; botocore retries everything else, as configured below

    def __init__(self, **options: Any) -> None:
        options.setdefault("use_listings_cache", False)  # other processes write too
        options.setdefault("config_kwargs", {"retries": {"total_max_attempts": _ATTEMPTS, "mode": "standard"}})
        self.fence: Callable[[], bool] | None = None
        """When it returns False, all calls end, waiting ones too: another writer holds the lease."""
        super().__init__(**options)

    async def _call_s3(self, method: str, *akwarglist: Any, **kwargs: Any) -> Any:
        call = asyncio.ensure_future(super()._call_s3(method, *akwarglist, **kwargs))
        try:
            while not (await asyncio.wait({call}, timeout=_FENCE_POLL_S))[0]:
                if self.fence is not None and not self.fence():
                    call.cancel()
                    raise StoreError(
                        f"s3://{kwargs.get('Bucket')}: the right to write was lost while it did not answer"
                    )
            return call.result()
        except _FOREIGN_ERRORS as error:
            raise _translate_error(error, kwargs.get("Bucket"), kwargs.get("Key") or kwargs.get("Prefix")) from error

    call_s3 = sync_wrapper(_call_s3)

    async def _cat_file(self, path: str, **options: Any) -> bytes:
        try:
            data: bytes = await super()._cat_file(path, **options)
        except _FOREIGN_ERRORS as error:
            bucket, key, _ = self.split_path(path)
            raise _translate_error(error, bucket, key) from error
        return data

    async def _isfile(self, path: str) -> bool:
        try:  # the inherited method returns False on every failure
            return bool((await self._info(path))["type"] == "file")
        except FileNotFoundError:
            return False

    async def _lsdir(self, path: str, *args: Any, **options: Any) -> list[dict[str, Any]]:
        try:
            found: list[dict[str, Any]] = await super()._lsdir(path, *args, **options)
        except _FOREIGN_ERRORS as error:
            bucket, key, _ = self.split_path(path)
            raise _translate_error(error, bucket, key) from error
        return found

    def list_sizes(self, folder: str, recursive: bool = False) -> dict[str, int]:
        """List the objects in a folder by name, sorted, with their sizes [bytes]; folders in it have size 0.

        With `recursive`, list all objects below it by relative path. A missing folder is empty.
        """
        bucket, key, _ = self.split_path(folder)
        prefix = f"{key.rstrip('/')}/" if key else ""
        sizes: dict[str, int] = {}
        more: dict[str, str] = {} if recursive else {"Delimiter": "/"}
        while True:
            page = self.call_s3("list_objects_v2", Bucket=bucket, Prefix=prefix, **more)
            sizes |= {entry["Key"][len(prefix) :]: entry["Size"] for entry in page.get("Contents", ())}
            sizes |= {entry["Prefix"][len(prefix) :].rstrip("/"): 0 for entry in page.get("CommonPrefixes", ())}
            if not page.get("IsTruncated"):
                return {name: sizes[name] for name in sorted(sizes) if name}
            more["ContinuationToken"] = page["NextContinuationToken"]

    def remove(self, path: str) -> None:
        """Remove an object if it exists."""
        bucket, key, _ = self.split_path(path)
        self.call_s3("delete_object", Bucket=bucket, Key=key)

    def remove_all(self, folder: str, keep: str = "") -> None:
        """Remove every object below a folder except the one named `keep`."""
        bucket, key, _ = self.split_path(folder)
        prefix = f"{key.rstrip('/')}/" if key else ""
        names = [name for name in self.list_sizes(folder, recursive=True) if name != keep]
        for start in range(0, len(names), _MAX_DELETED):
            objects = [{"Key": prefix + name} for name in names[start : start + _MAX_DELETED]]
            answer = self.call_s3("delete_objects", Bucket=bucket, Delete={"Objects": objects, "Quiet": True})
            for error in answer.get("Errors", ()):
                raise _translate_error(ClientError({"Error": error}, "DeleteObjects"), bucket, error.get("Key"))

    def put_if_absent(self, path: str, data: bytes) -> str | None:
        """Write a new object; returns its etag, or None if there is one with other bytes."""
        return self._put_if(path, data, IfNoneMatch="*")

    def put_if_match(self, path: str, data: bytes, etag: str) -> str | None:
        """Replace the version `etag` of an object; returns the new etag, or None if another version is there."""
        return self._put_if(path, data, IfMatch=etag)

    def head_and_get(self, path: str) -> VersionedObject | None:
        """Read an object with its version and age; None if there is none."""
        bucket, key, _ = self.split_path(path)
        try:
            head = self.call_s3("head_object", Bucket=bucket, Key=key)
            data = self.cat_file(path)
        except FileNotFoundError:
            return None
        now = parsedate_to_datetime(head["ResponseMetadata"]["HTTPHeaders"]["date"])
        return VersionedObject(data, head["ETag"], (now - head["LastModified"]).total_seconds())

    def abort_uploads(self, folder: str) -> int:
        """Abort incomplete uploads below a folder, whose parts would be billed; returns how many."""
        bucket, key, _ = self.split_path(folder)
        found: list[tuple[str, str]] = []
        more = {"Prefix": f"{key.rstrip('/')}/" if key else ""}
        while True:
            page = self.call_s3("list_multipart_uploads", Bucket=bucket, **more)
            found += [(upload["Key"], upload["UploadId"]) for upload in page.get("Uploads", ())]
            if not page.get("IsTruncated"):
                break
            more |= {"KeyMarker": page["NextKeyMarker"], "UploadIdMarker": page["NextUploadIdMarker"]}
        for name, upload_id in found:
            with suppress(FileNotFoundError):  # it was completed or aborted since
                self.call_s3("abort_multipart_upload", Bucket=bucket, Key=name, UploadId=upload_id)
        return len(found)

    def _put_if(self, path: str, data: bytes, **condition: str) -> str | None:
        bucket, key, _ = self.split_path(path)
        try:
            etag: str = self.call_s3("put_object", Bucket=bucket, Key=key, Body=data, **condition)["ETag"]
        except (PreconditionFailedError, FileNotFoundError):
            # A lost answer is retried, and then finds the object that the first attempt wrote.
            found = self.head_and_get(path)
            return found.etag if found is not None and found.data == data else None
        return etag


def _translate_error(error: Exception, bucket: str | None, key: str | None) -> Exception:
    if isinstance(error, StoreError):
        return error
    cause = error.__cause__ if isinstance(error.__cause__, ClientError) else error
    code = str(cause.response["Error"].get("Code", "")) if isinstance(cause, ClientError) else ""
    uri = f"s3://{bucket or ''}" + (f"/{key.rstrip('/')}" if key else "")
    if code == "NoSuchBucket":
        problem = f"there is no bucket {bucket}: make it, or correct its name"
    elif isinstance(error, FileNotFoundError):
        return error
    elif code in _CONDITION_CODES:
        return PreconditionFailedError(f"{uri}: another process has written it")
    elif isinstance(error, _CREDENTIAL_ERRORS):
        problem = (
            "no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE, or run where a role "
            "gives them"
        )
    elif isinstance(error, PermissionError) or code in _REFUSED_CODES:
        problem = (
            f"access denied ({code or 'no reason given'}): see docs/storage.md for what the credentials must allow"
        )
    elif isinstance(cause, ClientError):
        problem = f"the store answers {code}: {_redact(cause.response['Error'].get('Message'))}"
    else:
        problem = (
            f"the store does not answer ({type(error).__name__}: {_redact(error)}): look at AWS_ENDPOINT_URL and "
            "the network"
        )
    return StoreError(f"{uri}: {problem}. What is committed is kept: run the same command again")


def _redact(text: object) -> str:
    """Shorten text to one line without users, passwords and query strings."""
    plain = re.sub(r"(?<=://)[^/\s@]*@", "", " ".join(str(text).split()))
    return re.sub(r"\?[^\s\"']*", "", plain)[:300]
