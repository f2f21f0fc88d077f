"""Pictures from compressed assets, and measures between pictures."""
