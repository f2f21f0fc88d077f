"""What CTA is judged by: all-frequency CPCA on a segmented light axis, and wavelet compression.

They take transfer as it was sampled, over the texels of a cube map, and are no job's methods: they
stand beside the others in measurements.
"""
