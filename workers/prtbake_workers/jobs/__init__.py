"""The only place that sees storage and the queue: one module a job kind."""
