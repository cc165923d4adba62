// Rasterizes triangles in homogeneous image coordinates (Olano and Greer 1997). It clips no triangle, and needs no
// special care for what passes behind the eye.
//
// A triangle has the rows (a, b, c) of (x, y, w). It shows a point p = (x, y, 1) of the image with the barycentrics e /
// (e₀ + e₁ + e₂). Here e₀ = p · (b × c), e₁ = p · (c × a), e₂ = p · (a × b). The point lies in front of the eye where
// all e have the sign of a · (b × c). Signs are exact, and a centre on an edge counts as lying next to it, on the same
// side for all triangles. Each surface without a border therefore covers each centre as often from the front as from
// the back.
#pragma once

#include "core/array.h"
#include "core/parallel.h"
#include "raster/triangles.h"

namespace edgegrad {

template <class T>
struct RasterImages {
    Array<T> rast;     // (count, height, width, 4): u, v, z/w, triangle + 1
    Array<T> rast_db;  // (count, height, width, 4): ∂u/∂X, ∂u/∂Y, ∂v/∂X, ∂v/∂Y per pixel; may be empty
};

// Finds the nearest surfaces; if `behind` (count, height, width) exists, only those whose depth, as T, exceeds it.
template <class T>
RasterImages<T> rasterize(const Triangles<T>& mesh, const Frames& frames, const T* behind, bool derivatives,
                          ThreadTeam& team);

// Returns the cotangent of the positions, in the shape of pos; those of z are zero. `db_bar` may be null.
template <class T>
Array<T> rasterize_vjp(const Triangles<T>& mesh, const Frames& frames, const T* rast, const T* rast_bar,
                       const T* db_bar, ThreadTeam& team);

}  // namespace edgegrad
