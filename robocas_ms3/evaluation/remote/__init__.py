"""Policies behind a websocket, in messages that openpi's client and server understand too.

`client` is the policy that asks a server; `server` serves any policy. `messages` and `wire` are the format, which
docs/remote_policies.md describes.
"""

from robocas_ms3.core.errors import require_extra

require_extra("remote", "remote policies", "msgpack", "websockets")
