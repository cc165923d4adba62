// The samples themselves, for shaders written in PyTorch: what each shows, and how what it shows moves.
//
// Nothing here depends on radiance. Inside a face the caller differentiates its shader at barycentrics that move with
// the vertices and the intrinsics while the pixel position stays. On a curve he evaluates it on both sides, and the
// velocity of the curve is a linear form in what moves: rows of vertices in camera coordinates, and the intrinsics.
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

// The accumulation that keeps samples (accumulation.h).
struct Record {
    bool intrinsics = true;  // whether derivatives by them are kept: else those arrays are empty
};

constexpr int intrinsics_width = 6 + most_coefficients;  // K in rows, then the distortion

// Samples inside faces. Arrays side by side, one entry or row for each.
struct SurfaceRecords {
    std::vector<int32_t> face;
    std::vector<double> x;  // (S, 2) pixel position
    // (S, 3) where the ray goes, in camera coordinates; of an orthographic view, the place that it goes through.
    std::vector<double> along;
    std::vector<double> along_by_k;  // (S, 3, 14) ∂along/∂intrinsics at fixed x
    std::vector<double> weight;      // px² that it stands for

    // Makes room for so many.
    void reserve(int64_t n) { face.reserve(n), x.reserve(2 * n), along.reserve(3 * n), weight.reserve(n); }
};

// Rays of a camera as functions of where they go and of its intrinsics; see SurfaceRecords.
struct RayRecords {
    std::vector<double> along;       // (N, 3)
    std::vector<double> along_by_x;  // (N, 3, 2)
    std::vector<double> along_by_k;  // (N, 3, 14)
};

// Samples on curves. One on which two curves lie at a time has an entry for each that moves.
struct CurveRecords {
    static constexpr int surfaces = 3;  // at most
    std::vector<double> x;              // (S, 2) pixel position
    std::vector<int32_t> face;          // (S, 3) of its surfaces; −1: the background, −2: none
    std::vector<double> b;              // (S, 3, 2) where on them
    std::vector<double> factor;         // (S, 3): the jump, times what the sample stands for, is Σ factor · radiance
    std::vector<double> by_k;           // (S, 14) velocity of the curve by the intrinsics
    std::vector<int64_t> row_of;        // (R,): the sample of each row
    std::vector<int32_t> vertex;        // (R,)
    std::vector<double> by_q;           // (R, 3) velocity by the vertex in camera coordinates
    // Of steps within faces: rows by texture coordinates and by alpha texels.
    std::vector<int64_t> uv_row_of;     // (P,): the sample of each row
    std::vector<int32_t> uv;            // (P,)
    std::vector<double> by_uv;          // (P, 2)
    std::vector<int64_t> alpha_row_of;  // (Q,): the sample of each row
    std::vector<int64_t> alpha;         // (Q,)
    std::vector<double> by_alpha;       // (Q,)
    // Of what is seen through faces: rows by these.
    std::vector<int64_t> transparent_row_of;  // the sample of each row
    std::vector<int32_t> transparent;         // the face
    std::vector<double> transparent_b;        // (2) where on it
    // Of borders of shadows, a row a sample: the point of the light, and the velocity by its place in camera
    // coordinates, or by the direction towards it. The first surface is that in the light, the second that in the
    // shadow.
    std::vector<int32_t> light;    // (S,) the part of the light
    std::vector<double> light_uv;  // (S, 2) where on it
    std::vector<double> by_light;  // (S, 3)

    int64_t size() const { return int64_t(x.size()) / 2; }
    // Makes room for so many, with the vertices of an edge and of a face each.
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

// Those of chunks of samples, in order.
struct RecordList {
    std::vector<SurfaceRecords> surface;
    std::vector<CurveRecords> curves;
};

// One array of them end to end.
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
// The same of rows that name samples, as they are numbered then.
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

// A cotangent of a window's intrinsics as one of the camera's.
inline void append_intrinsics(std::vector<double>& to, const Camera& sub_camera, const IntrinsicsGrad& bar) {
    double of_camera[intrinsics_width] = {};
    add_intrinsics(sub_camera, bar, of_camera, of_camera + 6);
    to.insert(to.end(), of_camera, of_camera + intrinsics_width);
}

// Appends the ray that goes to n in a window's image: in the frame of the camera, with its derivatives at fixed x.
inline void append_ray(const Camera& sub_camera, Vec2 n, std::vector<double>& along, std::vector<double>* along_by_k,
                       std::vector<double>* along_by_x = nullptr) {
    const Mat3& turn = sub_camera.turn;
    const Vec3 direction = transposed_times(turn, {n.x, n.y, 1});
    append(along, {direction.x, direction.y, direction.z});
    if (!along_by_k && !along_by_x) return;
    for (const Vec2 by_n :
         {Vec2{turn.row[0].x, turn.row[1].x}, Vec2{turn.row[0].y, turn.row[1].y}, Vec2{turn.row[0].z, turn.row[1].z}}) {
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
