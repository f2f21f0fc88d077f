"""Files of finished jobs on their way out."""
