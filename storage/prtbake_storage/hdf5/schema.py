"""Names, version and layout rules of prtbake's HDF5 files.

::

    /                 attributes format="prtbake", version, kind (one of KINDS)
    /provenance       JSON text: input digests, settings, seeds, versions, plan
    /mesh/            positions normals faces uv; of kind mesh also colours face_groups group_names
    /basis/           centres; attributes kernel, bandwidth.  Or attributes kind="sh", order
    /light/           attribute error and coefficients; of lobes centres bandwidths, of wavelets
                      indices and attribute resolution; attribute method but for scattered lobes
    /environment/     radiance
    /brdf/            the arrays of a measured BRDF; attribute parametrisation
    /parts/<i>/       attributes name, role, vertex_start, vertex_stop, n_channels, method;
                      two_sided = 1 where it is so (`prtbake_storage.decode.sides`);
                      quantisation_error, the squared-error ratio that rounding adds
        material      JSON text
        albedo albedo_texture vertex_colours factorisation/
        clusters/     labels ranks light_bases dual_bases means components
        weights       ...
        superclusters/  of_cluster indices starts; attribute registers.  Where asked for

Which factors a part has goes by its ``method``, see `prtbake_storage.decode.asset.FACTORS`.

Where ``n_channels`` is 3, transfer differs by colour.  An axis ``channel*term``, and its like in
the factors, then runs through red, green and blue one after the other, as ``c * terms + k``.

A renderer that holds the data of few clusters at a time draws rows ``starts[s]`` to ``starts[s+1]``
of ``superclusters/indices``, vertices of the mesh, with the clusters whose ``of_cluster`` is ``s``
loaded, and adds up what it draws; a vertex whose cluster is of another supercluster is black.

A rounded factor is an int8 or int16 dataset ``x`` beside a float32 dataset ``x_scale`` named by
its attribute ``scale``; the value is ``(x - offset) * scale``, broadcast (the rows of ``weights``
take those of their cluster).  ``offset`` is an attribute, 0 where there is none; ``bits`` says how
many the largest level takes with its sign.  The root's ``bits`` is that of the factor with most,
or 32 where factors are float32.  Every dataset carries the names
of its axes in the attribute ``axes``.  Datasets are chunked, gzip + shuffle + fletcher32, and
the metadata of library version 1.10 carries its own checksums: any changed byte that matters is
found.  No times are written, so equal content is equal bytes.
"""

FORMAT = "prtbake"
VERSION = 1
KINDS = ("asset", "transfer", "bounces", "light", "mesh", "environment", "brdf")

LIBVER = ("v110", "v110")
"""HDF5 1.10 (2016): the oldest whose metadata has checksums."""

GZIP_LEVEL = 4
TRANSFER_GZIP_LEVEL = 1
"""Transfer is noise in its low bits: higher levels cost three times as much for 2 % less."""

TRANSFER_CHUNK_BYTES = 1 << 20
CHUNK_BYTES = 1 << 18
"""Target size of a chunk before compression."""

MAX_DEFLATE_RATIO = 1100
"""deflate cannot shrink beyond 1032:1, so a dataset that claims more was never written."""

MAX_JSON_BYTES = 16 << 20
ALLOWED_FILTERS = frozenset({1, 2, 3})
"""deflate, shuffle, fletcher32."""


def transfer_chunk_vertices(n_rows: int, n_coeffs: int) -> int:
    """Vertices in a chunk of transfer: a power of two near 1 MiB; tiles start at its multiples.

    ``n_rows`` is that of a vertex, channels * terms.
    """
    fitting = max(1, TRANSFER_CHUNK_BYTES // (2 * n_rows * n_coeffs))
    return min(1 << (fitting.bit_length() - 1), 4096)
