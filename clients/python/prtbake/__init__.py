"""SDK and command line of prtbake."""
