// Which triangle covers the centre of each pixel, in homogeneous coordinates of the image (Olano and Greer 1997): no
// triangle is clipped, and what passes behind the eye needs no care.
//
// A point p = (x, y, 1) of the image is seen in the triangle (a, b, c), rows (x, y, w), with barycentrics e / (e₀ + e₁
// + e₂), e₀ = p · (b × c), e₁ = p · (c × a), e₂ = p · (a × b); it lies before the eye where all e have the sign of a ·
// (b × c). Signs are exact, and a centre on an edge is taken as lying next to it, on the same side for all triangles:
// each surface without a border covers each centre as often from the front as from the back.
#pragma once

#include "core/array.h"
#include "core/parallel.h"
#include "raster/triangles.h"

namespace edgegrad {

template <class T>
struct RasterImages {
    Array<T> rast;     // (count, height, width, 4): u, v, z/w, triangle + 1
    Array<T> rast_db;  // (count, height, width, 4): ∂u/∂X, ∂u/∂Y, ∂v/∂X, ∂v/∂Y a pixel; empty unless wanted
};

// Of the surfaces nearest to the eye whose depth, as T, is larger than `behind` (count, height, width), if that is
// there.
template <class T>
RasterImages<T> rasterize(const Triangles<T>& mesh, const Frames& frames, const T* behind, bool derivatives,
                          ThreadTeam& team);

// The cotangent of the positions, of the shape of pos; those of z are zero. `db_bar` may be null.
template <class T>
Array<T> rasterize_vjp(const Triangles<T>& mesh, const Frames& frames, const T* rast, const T* rast_bar,
                       const T* db_bar, ThreadTeam& team);

}  // namespace edgegrad
