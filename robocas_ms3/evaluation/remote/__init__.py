"""Policies on the other end of a websocket, in messages that openpi's client and server understand too.

``wire`` turns values to bytes and back, ``messages`` says what is in them, ``client`` is a `Policy` that asks a server,
``server`` lets any `Policy` answer. docs/remote_policies.md has the messages.
"""

from robocas_ms3.errors import MissingExtraError

try:
    import msgpack  # noqa: F401
    import websockets  # noqa: F401
except ImportError as error:
    raise MissingExtraError(
        f"remote policies need {error.name or 'websockets and msgpack'}, which is not installed",
        fix='Run pip install "robocas-ms3[remote]".',
    ) from error
