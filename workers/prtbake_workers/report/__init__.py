"""The account of a job: errors, effects, seconds, bytes; JSON and HTML."""
