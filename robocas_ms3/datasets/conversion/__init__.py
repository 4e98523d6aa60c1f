"""From recordings to a RoboCAS folder."""
