"""Light transport to a surface: visibility, projection, reference integration."""
