"""Drawing in a browser, for the service's page and for pages that jobs leave."""

from pathlib import Path

FRONTIER_SCRIPT = Path(__file__).with_name("frontier.js")
"""A module that exports ``drawFrontier(container, study)``; it needs no other script or style."""
