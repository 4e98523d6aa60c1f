"""RoboCAS datasets: one declared schema, the converter, the validator, videos."""
