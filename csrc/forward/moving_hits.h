// Computes where camera rays hit the planes of faces, as functions of the vertices, of the camera pose and of the rays.
#pragma once

#include <cstdint>

#include "core/parallel.h"

namespace edgegrad {

// Points to the inputs, or to their derivatives; null: zero.
template <class Number>
struct MovingArrays {
    Number* verts = nullptr;            // (V, 3) world coordinates
    Number* world_to_camera = nullptr;  // (4, 4)
    // (N, rays, 3) in camera coordinates: directions of rays from the eye, or points that rays along the axis pass in
    // an orthographic view.
    Number* along = nullptr;
};

struct MovingHits {
    const int32_t* faces;  // (F, 3) rows of verts
    const int64_t* face;   // (N,)
    int64_t size;
    bool perspective;
    int rays = 1;  // number of rays per face
};

// Writes barycentrics (N, rays, 3). Degenerate or edge-on faces get those of the first corner, without derivatives.
void intersect_planes(const MovingHits& hits, const MovingArrays<const double>& at, double* b, ThreadTeam& team);
// Adds to the cotangents of vertices and camera, and writes those of `along`.
void intersect_planes_vjp(const MovingHits& hits, const MovingArrays<const double>& at, const double* b_bar,
                          const MovingArrays<double>& to, ThreadTeam& team);
void intersect_planes_jvp(const MovingHits& hits, const MovingArrays<const double>& at,
                          const MovingArrays<const double>& tangents, double* b_dot, ThreadTeam& team);

// Describes how numbers of samples move with rows of a table: each is the sum over its rows of by · moved row.
struct LinearForm {
    const int64_t *sample, *row;  // (N,)
    const double* by;             // (N, width)
    int64_t size, width;
};

// Adds Σ bar[sample] · by to the rows of the table's cotangent.
void form_vjp(const LinearForm& form, const double* bar, double* table_bar, ThreadTeam& team);

}  // namespace edgegrad
