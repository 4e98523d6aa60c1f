"""Policies behind a websocket, in messages that openpi's client and server understand too.

`client` is the policy that asks a server; `server` serves any policy. `messages` and `wire` are the format, which
docs/remote_policies.md describes.
"""

from robocas_ms3.core.errors import MissingExtraError

try:
    import msgpack  # noqa: F401
    import websockets  # noqa: F401
except ImportError as error:
    raise MissingExtraError(
        f"remote policies need {error.name or 'websockets and msgpack'}, which is not installed",
        fix='In the clone: pip install -e ".[remote]"',
    ) from error
