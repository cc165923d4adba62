// Blends pixels across silhouettes, by where an edge passes between their centres (Laine et al. 2020, section 3.5).
//
// Of two adjacent pixels in a row that show different triangles, the nearer triangle ends between their centres. It may
// end with a silhouette: an edge without a second triangle, or whose other triangles lie on the same side in the image.
// If the silhouette is more vertical than horizontal, the surface covers a fraction d of the way from its own centre to
// the other. A straight edge through both pixels' row has that fraction of the row on its side, on average. If d > ½, d
// − ½ of it is blended into the other pixel; otherwise ½ − d of the other is blended into its own. Pixels above each
// other are treated likewise.
#pragma once

#include <optional>
#include <vector>

#include "core/array.h"
#include "core/parallel.h"
#include "raster/triangles.h"

namespace edgegrad {

// Groups half-edges 3 t + i, opposite to corner i of triangle t. The half-edges with the same vertices, including
// itself, are member[start[k]] … member[start[k + 1] − 1] for k = group of the half-edge.
struct EdgeGroups {
    const int32_t *group, *start, *member;
};

// Describes a silhouette between the centres of two pixels.
struct SilhouetteCrossing {
    int64_t near, far;  // pixel whose triangle ends, and the other
    int32_t triangle;   // This triangle ends.
    int8_t side, axis;  // The side is opposite to this corner; the pixels lie along x (0) or y (1).
    double share;       // d: how far the triangle reaches from near to far, 0 to 1
};

// Finds the crossings, image by image.
template <class T>
std::vector<SilhouetteCrossing> find_crossings(const Triangles<T>& mesh, const Frames& frames, const EdgeGroups& edges,
                                               const T* rast, ThreadTeam& team);

// Returns the blended image (pixels, channels).
template <class T>
Array<T> antialias(const std::vector<SilhouetteCrossing>& crossings, const Frames& frames, int channels, const T* color,
                   ThreadTeam& team);

template <class T>
struct AntialiasGrad {
    std::optional<Array<T>> color, pos;
};
struct AntialiasWanted {
    bool color, pos;
};

template <class T>
AntialiasGrad<T> antialias_vjp(const std::vector<SilhouetteCrossing>& crossings, const Triangles<T>& mesh,
                               const Frames& frames, int channels, const T* color, const T* bar, AntialiasWanted wanted,
                               ThreadTeam& team);

}  // namespace edgegrad
