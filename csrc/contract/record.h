// The samples themselves, for shaders written in PyTorch: what each shows, and how what it shows moves.
//
// Nothing here depends on radiance. Inside a face the caller differentiates its shader at barycentrics that move with
// the vertices and the intrinsics while the pixel position stays. On a curve he evaluates it on both sides, and the
// velocity of the curve is a linear form in what moves: rows of vertices in camera coordinates, and the intrinsics.
#pragma once

#include <cstdint>
#include <vector>

#include "camera/camera.h"
#include "camera/windows.h"
#include "core/math.h"

namespace edgegrad {

// The contraction that keeps samples (contraction.h).
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

    void clear();
    void add(const SurfaceRecords& o);
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
    // Of borders of shadows, a row a sample: the point of the light, and the velocity by its place in camera
    // coordinates, or by the direction towards it. The first surface is that in the light, the second that in the
    // shadow.
    std::vector<int32_t> light;    // (S,) the part of the light
    std::vector<double> light_uv;  // (S, 2) where on it
    std::vector<double> by_light;  // (S, 3)

    int64_t size() const { return int64_t(x.size()) / 2; }
    void clear();
    // Makes room for so many more, with rows of so many vertices each.
    void reserve(int64_t more, int64_t vertices);
    void add(const CurveRecords& o);
};

struct Records {
    SurfaceRecords surface;
    CurveRecords curves;
};

template <class T>
void append(std::vector<T>& to, const std::vector<T>& from) {
    to.insert(to.end(), from.begin(), from.end());
}

// A cotangent of a window's intrinsics as one of the camera's.
inline void append_intrinsics(std::vector<double>& to, const Camera& window, const IntrinsicsGrad& bar) {
    double of_camera[intrinsics_width] = {};
    add_intrinsics(window, bar, of_camera, of_camera + 6);
    to.insert(to.end(), of_camera, of_camera + intrinsics_width);
}

// Appends the ray that goes to n in a window's image: in the frame of the camera, with its derivatives at fixed x.
inline void append_ray(const Camera& window, Vec2 n, std::vector<double>& along, std::vector<double>* along_by_k,
                       std::vector<double>* along_by_x = nullptr) {
    const Mat3& turn = window.turn;
    const Vec3 direction = transposed_times(turn, {n.x, n.y, 1});
    append(along, {direction.x, direction.y, direction.z});
    if (!along_by_k) return;
    for (const Vec2 by_n :
         {Vec2{turn.row[0].x, turn.row[1].x}, Vec2{turn.row[0].y, turn.row[1].y}, Vec2{turn.row[0].z, turn.row[1].z}}) {
        IntrinsicsGrad bar;
        normalised_vjp(window, n, by_n, bar);
        append_intrinsics(*along_by_k, window, bar);
        if (!along_by_x) continue;
        const Vec2 by_x = pixel_vjp(window, n, by_n);
        append(*along_by_x, {by_x.x, by_x.y});
    }
}

template <class T>
void reserve_more(std::vector<T>& to, int64_t more) {
    to.reserve(to.size() + size_t(more));
}

inline void SurfaceRecords::clear() { face.clear(), x.clear(), along.clear(), along_by_k.clear(), weight.clear(); }

inline void SurfaceRecords::add(const SurfaceRecords& o) {
    append(face, o.face), append(x, o.x), append(along, o.along), append(along_by_k, o.along_by_k),
        append(weight, o.weight);
}

inline void CurveRecords::clear() {
    x.clear(), face.clear(), b.clear(), factor.clear(), by_k.clear();
    row_of.clear(), vertex.clear(), by_q.clear();
    uv_row_of.clear(), uv.clear(), by_uv.clear();
    alpha_row_of.clear(), alpha.clear(), by_alpha.clear();
    light.clear(), light_uv.clear(), by_light.clear();
}

inline void CurveRecords::reserve(int64_t more, int64_t vertices) {
    reserve_more(x, 2 * more), reserve_more(face, surfaces * more), reserve_more(b, 2 * surfaces * more);
    reserve_more(factor, surfaces * more);
    reserve_more(row_of, vertices * more), reserve_more(vertex, vertices * more),
        reserve_more(by_q, 3 * vertices * more);
}

inline void CurveRecords::add(const CurveRecords& o) {
    const int64_t before = size();
    append(x, o.x), append(face, o.face), append(b, o.b), append(factor, o.factor), append(by_k, o.by_k);
    const auto append_rows = [&](std::vector<int64_t>& to, const std::vector<int64_t>& from) {
        for (const int64_t i : from) to.push_back(before + i);
    };
    append_rows(row_of, o.row_of), append(vertex, o.vertex), append(by_q, o.by_q);
    append_rows(uv_row_of, o.uv_row_of), append(uv, o.uv), append(by_uv, o.by_uv);
    append_rows(alpha_row_of, o.alpha_row_of), append(alpha, o.alpha), append(by_alpha, o.by_alpha);
    append(light, o.light), append(light_uv, o.light_uv), append(by_light, o.by_light);
}

}  // namespace edgegrad
