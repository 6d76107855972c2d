"""Requests of every operation that the OpenAPI document names, and what may be wrong with one."""

from __future__ import annotations

import base64
import json
import random
import string
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

Schema = Mapping[str, Any]

#: Texts that no id, number, name or time is.
JUNK = (
    "", " ", "0", "-1", "1", "2", "01", "1.0", "1e3", "0x10", "9" * 30, "nan", "Infinity", "null", "true", "[]", "{}",
    "..", "../..", "/", "a/b", "%", "%00", "\0", "\n", "\r\nX: y", "é", "\u202e", "\U0001f4a9", "\ufffd", "'", '"',
    "' OR 1=1 --", "; DROP TABLE maps", "%s%n", "${x}", "{{7*7}}", "a" * 64, "a" * 65, "a" * 5000, "-", "_", "*", "?",
    "2026-03-01T12:00:00Z", "2026-03-01", "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59",
    "2026-02-30T00:00:00Z", "1,2,3,4,5,6", "0,0,0,1,1,1", "nan,nan,nan,nan,nan,nan", "1e999,0,0,1,1,1", "1,2,3",
    "changed", "new", "appeared", "ascii", "spicd-net/1", "no-such/9", "spicd-net%2F1",
)  # fmt: skip
#: JSON values that no field expects, as text: some of them `json.dumps` would not write.
VALUES = (
    "null", "true", "0", "-1", "1e308", "1e999", "-1e999", "NaN", "Infinity", "9" * 400, "0.1", '""', '"a"', '"\\u0000"',
    '"\\ud800"', '"\\ud83d\\ude00"', "[]", "{}", "[[]]", "[null]", '{"": 1}', "[" * 500 + "]" * 500,
    "[" * 60_000 + "]" * 60_000, '"' + "a" * 5000 + '"', "[" + "0," * 3000 + "0]", '["a", "a"]', "1.5", "-0.0",
    '{"a": {"a": {"a": 1}}}', '"2026-03-01T12:00:00Z"', '"9999-12-31T23:59:59-23:59"',
)  # fmt: skip
CURSORS = (
    "[]", "[1]", '["a"]', "{}", "null", '"a"', "[null, null]", '["2026-03-01T12:00:00Z", "a"]', '["0x1p99999", "a"]',
    '["0x1p99999", "a", "b"]', '["2026-03-01T12:00:00Z", "\\ud800"]', '["2026-03-01T12:00:00Z", "\\u0000"]',
    '["2026-03-01T12:00:00Z", ["a"]]', '["2026-03-01T12:00:00Z", 1]', '["nan", "a"]', '["inf", "a", "b"]', "[1e999, 1]",
    '["9999-12-31T23:59:59-23:59", "a"]', "[[[[", "[" * 400 + "]" * 400, '["0x1.8p+1", "s", "t"]',
    '["2026-03-01T12:00:00Z", "2026-03-01T12:00:00Z", "a", "b"]', '["1", "2", "3"]', '["-1", "\\ud800", "\\u0000"]',
    '["999999999999999999999", "a"]', '["1e400", "a"]',
)  # fmt: skip
MEDIA_TYPES = (
    "", "application/json", "application/json; charset=utf-16", "application/octet-stream", "text/plain",
    "multipart/form-data", "multipart/form-data; boundary=", 'multipart/form-data; boundary=""', "multipart/mixed; boundary=b",
    "multipart/form-data; boundary=b", "multipart/form-data; boundary=" + "b" * 300, "application/x-www-form-urlencoded",
    "multipart/form-data; boundary=" + "b" * 100_000, "a/b; " * 500, "multipart/form-data; boundary*=utf-8''b%ff",
)  # fmt: skip
ODD_HEADERS: tuple[tuple[bytes, bytes], ...] = (
    (b"range", b"bytes=0-0"), (b"range", b"bytes=5-1"), (b"range", b"bytes=-5"), (b"range", b"bytes=999999999-"),
    (b"range", b"bytes=0-0,2-3,4-5"), (b"range", b"lines=1"), (b"if-range", b"x"), (b"if-none-match", b"*"),
    (b"if-modified-since", b"never"), (b"accept", b"image/png"), (b"accept-encoding", b"gzip, br"), (b"expect", b"100-continue"),
    (b"x-forwarded-proto", b"https"), (b"x-forwarded-for", b"\xff"), (b"cookie", b"a=" + b"b" * 4000), (b"te", b"trailers"),
    (b"idempotency-key", b'"a"'), (b"idempotency-key", b"b"), (b"idempotency-key", b'"'), (b"idempotency-key", b"\xff"),
    (b"x-http-method-override", b"DELETE"), (b"content-encoding", b"gzip"), (b"accept-language", b"\xe9"),
)  # fmt: skip


@dataclass(frozen=True)
class Request:
    """One request as a server would hand it to the app."""

    method: str
    path: str  #: percent-encoded
    query: str = ""
    headers: tuple[tuple[bytes, bytes], ...] = ()
    body: bytes = b""
    breaks_off: bool = False  #: the connection ends within the body

    def words(self) -> str:
        """Say what was asked, briefly."""
        kind = dict(self.headers).get(b"content-type", b"")
        return f"{self.method} {self.path[:150]}?{self.query[:150]} {kind[:60]!r} {self.body[:200]!r}"


@dataclass
class Requests:
    """Makes requests out of the OpenAPI document, about things that exist."""

    document: Mapping[str, Any]
    things: Mapping[str, list[str]]  #: ids that exist, by the name of the parameter
    cursors: list[str] = field(default_factory=list)  #: that the service gave

    def __post_init__(self) -> None:
        self._operations = [
            (method, path, operation)
            for path, operations in self.document["paths"].items()
            for method, operation in operations.items()
        ]

    def make(self, rng: random.Random) -> Request:
        """Make a request: sound, or with something wrong with it."""
        method, template, operation = rng.choice(self._operations)
        if method == "delete" and rng.random() < 0.9:  # else soon nothing would be left to ask for
            method, template, operation = rng.choice(self._operations)
        path = self._path(template, rng)
        headers = [(b"host", b"127.0.0.1:8000")]
        headers += [rng.choice(ODD_HEADERS) for _ in range(rng.choice((0, 0, 0, 1, 2)))]
        kind, body = self._body(operation, rng)
        if kind is not None:
            headers.append((b"content-type", kind))
        if kind is not None and rng.random() < 0.9:
            length = (
                rng.choice((0, len(body) // 2, len(body) + 5, 10**12)) if rng.random() < 0.05 else len(body)
            )
            headers.append((b"content-length", str(length).encode()))
        if rng.random() < 0.03:
            method = rng.choice(
                ("get", "head", "put", "patch", "delete", "options", "trace", "post", "QUERY", "a")
            )
        return Request(
            method=method.upper(),
            path=path,
            query=self._query(operation, rng),
            headers=tuple(headers),
            body=body,
            breaks_off=kind is not None and rng.random() < 0.02,
        )

    def _path(self, template: str, rng: random.Random) -> str:
        parts = []
        for part in template.split("/"):
            if not part.startswith("{"):
                parts.append(part if rng.random() < 0.995 else quote(rng.choice(JUNK)))
            elif rng.random() < 0.85:
                name = part.strip("{}").partition(":")[0]
                parts.append(quote(rng.choice(self.things[name]), safe="/" if name == "name" else ""))
            else:
                parts.append(quote(rng.choice(JUNK).encode()[:3000], safe=rng.choice(("", "/"))))
        return "/".join(parts) + ("/" if rng.random() < 0.005 else "")

    def _query(self, operation: Schema, rng: random.Random) -> str:
        given = []
        for parameter in operation.get("parameters", ()):
            if parameter["in"] != "query" or rng.random() < 0.6:
                continue
            for _ in range(rng.choice((1, 1, 1, 2))):
                given.append((parameter["name"], self._query_value(parameter, rng)))
        if rng.random() < 0.05:
            given.append((rng.choice(JUNK), rng.choice(JUNK)))
        return "&".join(f"{quote(name, safe='')}={_quoted(value, rng)}" for name, value in given)

    def _query_value(self, parameter: Schema, rng: random.Random) -> str:
        name = parameter["name"]
        if name == "cursor":
            if self.cursors and rng.random() < 0.4:
                return _damaged(rng.choice(self.cursors), rng)
            return base64.urlsafe_b64encode(rng.choice(CURSORS).encode()).decode().rstrip("=")
        if rng.random() < 0.4:
            return rng.choice(JUNK)
        value = self.value(parameter["schema"], rng, name)
        return value if isinstance(value, str) else json.dumps(value)

    def _body(self, operation: Schema, rng: random.Random) -> tuple[bytes | None, bytes]:
        content = operation.get("requestBody", {}).get("content", {})
        if not content:
            return (None, b"") if rng.random() < 0.95 else (b"application/json", b"{}")
        kind = rng.choice(list(content))
        schema = content[kind].get("schema", {})
        if kind == "application/json":
            body = _spoiled_json(self.value(schema, rng, ""), rng)
        elif kind == "multipart/form-data":
            return _form(self.value(schema, rng, ""), rng)
        else:
            body = scan(rng)
        if rng.random() < 0.05:
            return rng.choice(MEDIA_TYPES).encode(), body
        return kind.encode(), body

    def value(self, schema: Schema, rng: random.Random, name: str) -> Any:
        """Make a value that the schema admits, mostly."""
        if "$ref" in schema:
            schema = self.document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
        known = self.things.get(name) or self.things.get(name.removesuffix("s"))
        if schema.get("type") == "object" or "properties" in schema:
            needed = schema.get("required", ())
            properties = schema.get("properties", {})
            return {
                key: self.value(properties[key], rng, key)
                for key in properties
                if key in needed or rng.random() < 0.5
            }
        for several in ("anyOf", "oneOf", "allOf"):
            if several in schema:
                return self.value(rng.choice(schema[several]), rng, name)
        if schema.get("type") == "array":
            if "example" in schema:
                return schema["example"]
            fewest = max(1, schema.get("minItems", 0))
            count = rng.randint(fewest, max(fewest, min(schema.get("maxItems", 3), 6)))
            return [self.value(schema.get("items", {}), rng, name) for _ in range(count)]
        if known and rng.random() < 0.8:
            return rng.choice(known)
        return _scalar(schema, rng)


def _scalar(schema: Schema, rng: random.Random) -> Any:
    """Make a value of one of JSON's simple types."""
    for given in ("enum", "examples"):
        if given in schema:
            return rng.choice(schema[given])
    for given in ("const", "example", "default"):
        if given in schema:
            return schema[given]
    made = {
        "integer": rng.choice((schema.get("minimum", 0), schema.get("maximum", 7), 3)),
        "number": rng.choice((schema.get("minimum", 0.0), schema.get("maximum", 1.0), 0.5)),
        "boolean": rng.random() < 0.5,
        "null": None,
    }
    return made.get(schema.get("type", ""), "".join(rng.choices(string.ascii_lowercase, k=6)))


def scan(rng: random.Random) -> bytes:
    """Make the bytes of a small upload: a PLY in name, or something else."""
    sound = f"ply\nformat ascii 1.0\ncomment {rng.randrange(500)}\nend_header\n".encode()
    others = (
        b"",
        b"ply",
        b"\0" * 10,
        b"# .PCD\n",
        b"VERSION 0.7\nDATA ascii\n",
        rng.randbytes(30),
        sound * 9000,
    )
    return sound if rng.random() < 0.8 else rng.choice(others)


def _quoted(value: str, rng: random.Random) -> str:
    """Return a value percent-encoded, now and then as no encoder would."""
    if rng.random() < 0.02:
        return rng.choice(("%", "%zz", "%ff%fe", "%ed%a0%80", "%00", "+", ";", "&&", "=%3D="))
    return quote(value.encode("utf-8", "replace")[:6000], safe="")


def _damaged(text: str, rng: random.Random) -> str:
    """Return a text whole, cut or with another character."""
    at = rng.randrange(max(1, len(text)))
    return rng.choice((text, text, text[:at], text[:at] + rng.choice("A_-=%é\0") + text[at + 1 :], text * 40))


def _spoiled_json(value: Any, rng: random.Random) -> bytes:
    """Write a value as JSON, often with one part replaced or the text damaged."""
    text = json.dumps(value)
    if rng.random() < 0.4:
        return text.encode()
    if rng.random() < 0.6:
        mark = f"@@{rng.random()}"
        text = json.dumps(_replaced(value, mark, rng)).replace(json.dumps(mark), rng.choice(VALUES))
    encoded = text.encode()
    spoiled = (
        encoded[: rng.randrange(len(encoded) + 1)],
        encoded[:-1] + b"," + encoded[1:] if len(encoded) > 2 else b"{}",  # each key twice
        rng.choice((text.encode("utf-16"), b"\xef\xbb\xbf" + encoded, encoded + b"\xff", b"\xff" + encoded)),
        b"{" + b",".join(b'"a%d": 0' % (i % 3) for i in range(rng.choice((10, 5000)))) + b"}",
        rng.choice(VALUES).encode(),
    )
    return rng.choice(spoiled) if rng.random() < 0.35 else encoded


def _replaced(value: Any, mark: str, rng: random.Random) -> Any:
    """Return the value with one part of it replaced by the mark, or an entry more."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        if rng.random() < 0.1:
            return value | {rng.choice(JUNK): mark}
        key = rng.choice(list(value))
        return value | {key: _replaced(value[key], mark, rng)}
    if isinstance(value, list) and value and rng.random() < 0.7:
        at = rng.randrange(len(value))
        return [*value[:at], _replaced(value[at], mark, rng), *value[at + 1 :]]
    return mark


def _form(fields: Any, rng: random.Random) -> tuple[bytes, bytes]:
    """Write a form with files, often with something wrong; return its media type and body."""
    boundary = b"----spicd"
    parts = []
    for name, value in (fields if isinstance(fields, dict) else {}).items():
        if name in ("scans", "files", "file"):
            continue
        text = value if isinstance(value, str) else json.dumps(value)
        text = rng.choice((*VALUES, *JUNK)) if rng.random() < 0.15 else text
        parts.append(_part(f'form-data; name="{name}"', text.encode("utf-8", "replace"), rng))
    for _ in range(rng.choice((0, 1, 1, 2))):
        name = rng.choice(("scans", "scans", "scans", "file", "x"))
        file = rng.choice(("a.ply", "b.pcd", "../../x", "\0", "é" * 300, "", '"', "a" * 5000, "\ud800"))
        disposition = f'form-data; name="{name}"; filename="{file}"'
        parts.append(_part(disposition, scan(rng), rng))
    rng.shuffle(parts)
    if rng.random() < 0.02 and sum(map(len, parts)) < 2000:  # each file is a row and a blob: 2 ms, not a hang
        parts *= 50 if any(b"filename" in part for part in parts) else 700
    body = (
        b"".join(b"--" + boundary + b"\r\n" + part + b"\r\n" for part in parts) + b"--" + boundary + b"--\r\n"
    )
    kind = b"multipart/form-data; boundary=" + boundary
    spoil: tuple[Callable[[], tuple[bytes, bytes]], ...] = (
        lambda: (kind, body[: rng.randrange(len(body) + 1)]),
        lambda: (kind, body.replace(b"\r\n", b"\n")),
        lambda: (kind, body.replace(b"form-data", rng.choice((b"", b"attachment", b"form-data; " * 300)))),
        lambda: (kind, body + rng.randbytes(20)),
        lambda: (rng.choice(MEDIA_TYPES).encode(), body),
        lambda: (kind, rng.randbytes(100)),
    )
    return rng.choice(spoil)() if rng.random() < 0.2 else (kind, body)


def _part(disposition: str, content: bytes, rng: random.Random) -> bytes:
    header = b"Content-Disposition: " + disposition.encode("utf-8", "surrogatepass")
    if rng.random() < 0.05:
        header = rng.choice(
            (b"", header * 40, b"X: y\r\n" * 50 + header, header.replace(b":", b""), b":", b"\xff: \xff")
        )
    return header + b"\r\n\r\n" + content
