"""Edges, pieces and winding of a triangle mesh, all by position index."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from prtbake_workers.arrays import B8, F64, I32, I64, Bool, Float64, Int64


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of a mesh.

    Attributes
    ----------
    n_faces_at
        Number of faces at each edge: 1 boundary, 2 manifold, more non-manifold.
    edge_of
        Edge of each half-edge; half-edge 3 f + i runs from corner i to corner i + 1 of face f.
    forward
        Whether the half-edge runs from the lower to the higher vertex index.
    pairs
        The two half-edges of each manifold edge.
    """

    n_faces_at: Int64[I64, " edges"]
    edge_of: Int64[I64, " halves"]
    forward: Bool[B8, " halves"]
    pairs: Int64[I64, "manifold 2"]

    @property
    def n_boundary(self) -> int:
        """Number of edges with one face."""
        return int(np.count_nonzero(self.n_faces_at == 1))

    @property
    def n_non_manifold(self) -> int:
        """Number of edges with more than two faces."""
        return int(np.count_nonzero(self.n_faces_at > 2))

    @property
    def clashing(self) -> Bool[B8, " manifold"]:
        """Manifold edges that their two faces run along in the same direction."""
        clash: B8 = self.forward[self.pairs[:, 0]] == self.forward[self.pairs[:, 1]]
        return clash


def find_edges(faces: Int64[I64, "tris 3"]) -> Edges:
    """Collect the edges of ``faces``, whose indices must name positions, not UV splits."""
    start = faces.ravel()
    end = np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    _, edge_of, n_faces_at = np.unique(key, return_inverse=True, return_counts=True)
    order = np.argsort(edge_of, kind="stable")
    first = np.cumsum(n_faces_at) - n_faces_at
    manifold = first[n_faces_at == 2]
    pairs = np.stack([order[manifold], order[manifold + 1]], axis=1)
    return Edges(n_faces_at.astype(np.int64), edge_of.astype(np.int64), start < end, pairs)


def around_edges(
    edges: Edges, key: Float64[F64, " halves"] | None = None
) -> tuple[Int64[I64, " halves"], Int64[I64, " halves"]]:
    """Pair each half-edge with the next one at its edge, and the last with the first.

    Parameters
    ----------
    edges
        All edges; the half-edge of a boundary pairs with itself.
    key
        Orders the half-edges of an edge; None for the order of the faces.

    Returns
    -------
    halves, following
        Each half-edge once, and the one that comes after it.
    """
    order = np.argsort(edges.edge_of, kind="stable")
    if key is not None:
        order = np.lexsort((key, edges.edge_of))
    stop = np.cumsum(edges.n_faces_at)
    following = np.roll(order, -1)
    following[stop - 1] = order[stop - edges.n_faces_at]
    return order.astype(np.int64), following.astype(np.int64)


def corners_that_meet(
    edges: Edges, halves: Int64[I64, " pairs"], others: Int64[I64, " pairs"]
) -> tuple[Int64[I64, " corners"], Int64[I64, " corners"]]:
    """Pair the corners of two faces that lie at one end of their common edge, at both ends.

    Corner i of face f is 3 f + i, as is the half-edge that starts there.
    """
    ends, other_ends = (half - half % 3 + (half + 1) % 3 for half in (halves, others))
    alike = edges.forward[halves] == edges.forward[others]
    left = np.concatenate([halves, ends])
    right = np.concatenate(
        [np.where(alike, others, other_ends), np.where(alike, other_ends, others)]
    )
    return left, right


def connected(
    n: int, left: Int64[I64, " pairs"], right: Int64[I64, " pairs"]
) -> Int64[I64, " nodes"]:
    """Name the component of each of ``n`` nodes by the lowest node in it."""
    graph = coo_array((np.ones(len(left), np.int8), (left, right)), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    _, first, component = np.unique(label, return_index=True, return_inverse=True)
    return first[component].astype(np.int64)


def count_components(faces: Int64[I64, "tris 3"]) -> int:
    """Count the pieces that share no vertex position."""
    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    rows, columns = local[:, [0, 1]].ravel(), local[:, [1, 2]].ravel()
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(used), len(used)))
    count, _ = connected_components(graph, directed=False)
    return int(count)


@dataclass(frozen=True, eq=False)
class Winding:
    """What ``consistent_winding`` decided.

    Attributes
    ----------
    flip
        Faces to turn over.
    orientable
        False where some piece has no consistent winding (a Möbius strip); its faces stay.
    n_turned_outward
        Closed pieces whose winding enclosed a negative volume and were turned as a whole.
    n_inward_left
        Closed pieces left inside out because the caller did not ask.
    """

    flip: Bool[B8, " tris"]
    orientable: bool
    n_turned_outward: int
    n_inward_left: int


def consistent_winding(
    positions: Float64[F64, "verts 3"],
    faces: Int64[I64, "tris 3"],
    edges: Edges,
    *,
    outward: bool,
) -> Winding:
    """Choose the faces to turn over so that neighbours agree, and closed pieces face outwards.

    Each face is two nodes of a graph, as it is and turned over; a manifold edge joins the
    nodes that agree across it.  A piece is orientable if its two sheets stay apart; of these the
    one that turns fewer faces is taken, and for a closed piece the one of positive volume.
    Non-manifold edges say nothing about winding, so they do not join pieces.
    """
    n = len(faces)
    face_pairs = edges.pairs // 3
    clash = edges.clashing.astype(np.int64)
    left = np.concatenate([face_pairs[:, 0], face_pairs[:, 0] + n])
    right = np.concatenate([face_pairs[:, 1] + n * clash, face_pairs[:, 1] + n * (1 - clash)])
    cover = coo_array((np.ones(len(left), np.int8), (left, right)), shape=(2 * n, 2 * n))
    _, sheet = connected_components(cover, directed=False)
    as_is, turned = sheet[:n], sheet[n:]
    twisted = as_is == turned
    # a piece is named by the lower of its two sheets; on a tie that one keeps its first face
    piece = np.unique(np.minimum(as_is, turned), return_inverse=True)[1].astype(np.int64)
    n_pieces = int(piece.max(initial=-1)) + 1
    other_sheet = as_is > turned
    n_other = np.bincount(piece, other_sheet, n_pieces)
    n_all = np.bincount(piece, minlength=n_pieces)
    flip = other_sheet ^ (n_other > n_all - n_other)[piece]
    flip &= ~twisted

    closed = _closed_pieces(edges, piece, n_pieces)
    volumes = _signed_volumes(
        positions, np.where(flip[:, None], faces[:, ::-1], faces), piece, n_pieces
    )
    orientable_piece = np.bincount(piece, twisted, n_pieces) == 0
    inward = closed & orientable_piece & (volumes < 0.0)
    if outward:
        flip ^= inward[piece]
    count = int(np.count_nonzero(inward))
    return Winding(
        flip=flip,
        orientable=not bool(twisted.any()),
        n_turned_outward=count if outward else 0,
        n_inward_left=0 if outward else count,
    )


def _closed_pieces(edges: Edges, piece: I64, n_pieces: int) -> B8:
    """Pieces with exactly two of their own faces at each of their edges."""
    key = np.repeat(piece, 3) * len(edges.n_faces_at) + edges.edge_of
    unique, counts = np.unique(key, return_counts=True)
    odd = np.unique(unique[counts != 2] // max(len(edges.n_faces_at), 1))
    closed = np.ones(n_pieces, np.bool_)
    closed[odd] = False
    return closed


def _signed_volumes(positions: F64, faces: I64 | I32, piece: I64, n_pieces: int) -> F64:
    """Volume by the divergence theorem, about each piece's own middle against cancellation."""
    corners = positions[faces]
    centroids = corners.mean(axis=1)
    middle: F64 = np.stack(
        [np.bincount(piece, centroids[:, axis], n_pieces) for axis in range(3)], axis=1
    ).astype(np.float64)
    middle /= np.maximum(np.bincount(piece, minlength=n_pieces), 1)[:, None]
    a, b, c = np.moveaxis(corners - middle[piece][:, None, :], 1, 0)
    cones = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    return np.bincount(piece, cones, n_pieces).astype(np.float64)
