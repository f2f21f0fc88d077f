"""What tests of storage and of its users share; nothing of the product imports it."""
