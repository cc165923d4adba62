// Records samples for shaders written in PyTorch: what each sample shows, and how that moves.
//
// Records do not depend on radiance. Inside a face, the caller differentiates its shader at barycentrics that move with
// the vertices and the intrinsics while the pixel position stays fixed. On a curve, it evaluates the shader on both
// sides. The velocity of the curve is a linear form in rows of vertices in camera coordinates, and in the intrinsics.
#pragma once

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <vector>

#include "camera/camera.h"
#include "camera/sub_cameras.h"
#include "core/array.h"
#include "core/math.h"

namespace edgegrad {

// Selects the recording accumulation (accumulation.h).
struct Record {
    bool intrinsics = true;  // whether to keep derivatives with respect to them; otherwise their arrays are empty
};

constexpr int intrinsics_width = 6 + most_coefficients;  // K comes in rows, then the distortion.

// Holds samples inside faces, as arrays with one entry or row each.
struct SurfaceRecords {
    std::vector<int32_t> face;
    std::vector<double> x;  // (S, 2) pixel position
    // (S, 3) the ray's direction in camera coordinates, or the point that it passes in an orthographic view
    std::vector<double> along;
    std::vector<double> along_by_k;  // (S, 3, 14) ∂along/∂intrinsics at fixed x
    std::vector<double> weight;      // (S,) the area that it represents, px²

    // Reserves memory for n samples.
    void reserve(int64_t n) { face.reserve(n), x.reserve(2 * n), along.reserve(3 * n), weight.reserve(n); }
};

// Holds a camera's rays as functions of image position and intrinsics; see SurfaceRecords.
struct RayRecords {
    std::vector<double> along;       // (N, 3)
    std::vector<double> along_by_x;  // (N, 3, 2)
    std::vector<double> along_by_k;  // (N, 3, 14)
};

// Holds samples on curves. A sample on two curves at once has an entry for each that moves.
struct CurveRecords {
    static constexpr int surfaces = 3;  // maximum
    std::vector<double> x;              // (S, 2) pixel position
    std::vector<int32_t> face;          // (S, 3) surfaces; −1: the background, −2: none
    std::vector<double> b;              // (S, 3, 2) last two barycentrics on them
    std::vector<double> factor;         // (S, 3): the jump, times the weight of the sample, is Σ factor · radiance
    std::vector<double> by_k;           // (S, 14) velocity of the curve with respect to the intrinsics
    std::vector<int64_t> row_of;        // (R,) the sample of each row
    std::vector<int32_t> vertex;        // (R,)
    std::vector<double> by_q;           // (R, 3) velocity with respect to the vertex in camera coordinates
    // Discontinuities within faces add rows for texture coordinates and for alpha texels.
    std::vector<int64_t> uv_row_of;     // (P,) the sample of each row
    std::vector<int32_t> uv;            // (P,)
    std::vector<double> by_uv;          // (P, 2)
    std::vector<int64_t> alpha_row_of;  // (Q,) the sample of each row
    std::vector<int64_t> alpha;         // (Q,)
    std::vector<double> by_alpha;       // (Q,)
    // Surfaces seen through transparent faces add rows for these.
    std::vector<int64_t> transparent_row_of;  // the sample of each row
    std::vector<int32_t> transparent;         // the face
    std::vector<double> transparent_b;        // (2) last two barycentrics
    // Shadow boundaries add a row per sample: the point of the light, and the velocity with respect to its position in
    // camera coordinates, or to the direction towards it. The first surface is lit, the second in shadow.
    std::vector<int32_t> light;    // (S,) the part of the light
    std::vector<double> light_uv;  // (S, 2) last two barycentrics
    std::vector<double> by_light;  // (S, 3)

    int64_t size() const { return int64_t(x.size()) / 2; }
    // Reserves memory for n samples, each with the vertices of an edge and of a face.
    void reserve(int64_t n) {
        constexpr int rows = 5;
        x.reserve(2 * n), face.reserve(surfaces * n), b.reserve(2 * surfaces * n), factor.reserve(surfaces * n);
        row_of.reserve(rows * n), vertex.reserve(rows * n), by_q.reserve(3 * rows * n);
        light.reserve(n), light_uv.reserve(2 * n), by_light.reserve(3 * n);
    }
};

struct Records {
    SurfaceRecords surface;
    CurveRecords curves;
};

// Holds the records of chunks of samples, in order.
struct RecordList {
    std::vector<SurfaceRecords> surface;
    std::vector<CurveRecords> curves;
};

// Concatenates one array of all parts.
template <class Part, class X>
Array<X> joined(const std::vector<Part>& parts, std::vector<X> Part::* field, ThreadTeam& team) {
    std::vector<int64_t> first{0};
    for (const Part& part : parts) first.push_back(first.back() + int64_t((part.*field).size()));
    Array<X> out(first.back());
    team.parallel_for(int64_t(parts.size()), [&](int64_t k) {
        std::copy((parts[k].*field).begin(), (parts[k].*field).end(), out.data() + first[k]);
    });
    return out;
}
// Does the same for rows that refer to samples, and renumbers these.
inline Array<int64_t> joined_rows(const std::vector<CurveRecords>& parts, std::vector<int64_t> CurveRecords::* field,
                                  ThreadTeam& team) {
    Array<int64_t> out = joined(parts, field, team);
    int64_t *row = out.begin(), samples = 0;
    for (const CurveRecords& part : parts) {
        for (size_t i = 0; i < (part.*field).size(); ++i) *row++ += samples;
        samples += part.size();
    }
    return out;
}

template <class T>
void append(std::vector<T>& to, std::initializer_list<T> from) {
    for (const T& value : from) to.push_back(value);
}

// Appends a cotangent of a sub-camera's intrinsics as one of the camera's.
inline void append_intrinsics(std::vector<double>& to, const Camera& sub_camera, const IntrinsicsGrad& bar) {
    double of_camera[intrinsics_width] = {};
    add_intrinsics(sub_camera, bar, of_camera, of_camera + 6);
    to.insert(to.end(), of_camera, of_camera + intrinsics_width);
}

// Appends the ray to n in a sub-camera's image, in the frame of the camera, with its derivatives at fixed x.
inline void append_ray(const Camera& sub_camera, Vec2 n, std::vector<double>& along, std::vector<double>* along_by_k,
                       std::vector<double>* along_by_x = nullptr) {
    const Mat3& rotation = sub_camera.rotation;
    const Vec3 direction = transposed_times(rotation, {n.x, n.y, 1});
    append(along, {direction.x, direction.y, direction.z});
    if (!along_by_k && !along_by_x) return;
    for (const Vec2 by_n : {Vec2{rotation.row[0].x, rotation.row[1].x}, Vec2{rotation.row[0].y, rotation.row[1].y},
                            Vec2{rotation.row[0].z, rotation.row[1].z}}) {
        if (along_by_k) {
            IntrinsicsGrad bar;
            normalised_vjp(sub_camera, n, by_n, bar);
            append_intrinsics(*along_by_k, sub_camera, bar);
        }
        if (!along_by_x) continue;
        const Vec2 by_x = pixel_vjp(sub_camera, n, by_n);
        append(*along_by_x, {by_x.x, by_x.y});
    }
}

}  // namespace edgegrad
