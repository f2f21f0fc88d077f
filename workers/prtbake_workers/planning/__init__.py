"""Which effects a scene calls for, with which settings, at what predicted cost."""
