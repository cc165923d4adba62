// Pixels blended across silhouettes, by where an edge passes between their centres (Laine et al. 2020, section 3.5).
//
// Of two pixels side by side that show different triangles, the nearer triangle ends between their centres. Where it
// ends with a silhouette (an edge without a second triangle, or whose other triangles lie on the same side in the
// image) that runs more up than along, its surface covers a share d of the way from its own centre to the other. A
// straight edge through both pixels' row has on average that share of the row on its side: what of it belongs to the
// other pixel, d − ½, is blended into that, or ½ − d of the other into its own. Likewise for two pixels above each
// other.
#pragma once

#include <optional>
#include <vector>

#include "core/array.h"
#include "core/parallel.h"
#include "raster/triangles.h"

namespace edgegrad {

// Of each half-edge 3 t + i, opposite to corner i of triangle t: the half-edges with the same vertices, itself too, are
// member[start[k]] … member[start[k + 1] − 1] for k = group of it.
struct EdgeGroups {
    const int32_t *group, *start, *member;
};

// A silhouette between the centres of two pixels.
struct Crossing {
    int64_t near, far;  // pixels: whose triangle ends, and the other
    int32_t triangle;   // the one that ends
    int8_t side, axis;  // with the side opposite to this corner; the pixels lie along x (0) or y (1)
    double share;       // d: how far from near to far it reaches, 0 to 1
};

// Image by image.
template <class T>
std::vector<Crossing> find_crossings(const Triangles<T>& mesh, const Frames& frames, const EdgeGroups& edges,
                                     const T* rast, ThreadTeam& team);

// The blended image (pixels, channels).
template <class T>
Array<T> antialias(const std::vector<Crossing>& crossings, const Frames& frames, int channels, const T* color,
                   ThreadTeam& team);

template <class T>
struct AntialiasGrad {
    std::optional<Array<T>> color, pos;
};
struct AntialiasWanted {
    bool color, pos;
};

template <class T>
AntialiasGrad<T> antialias_vjp(const std::vector<Crossing>& crossings, const Triangles<T>& mesh, const Frames& frames,
                               int channels, const T* color, const T* bar, AntialiasWanted wanted, ThreadTeam& team);

}  // namespace edgegrad
