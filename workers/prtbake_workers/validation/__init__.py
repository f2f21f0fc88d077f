"""The chain of pictures between the reference and the asset: the error budget."""
