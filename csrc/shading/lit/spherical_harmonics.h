// Evaluates irradiance as a function of the normal, in real, orthonormal spherical harmonics up to the second order
// (Ramamoorthi and Hanrahan 2001).
#pragma once

#include "shading/lit/light.h"

namespace edgegrad {

constexpr int n_harmonics = 9;

// Writes Y_00, Y_1−1, Y_10, Y_11, Y_2−2 … Y_22 of a unit vector.
template <class S>
void harmonics(S x, S y, S z, S* Y) {
    const double one = 0.5 / std::sqrt(M_PI), c1 = std::sqrt(3 / (4 * M_PI)), c2 = std::sqrt(15 / (4 * M_PI)),
                 c3 = std::sqrt(5 / (16 * M_PI));
    Y[0] = S(one), Y[1] = S(c1) * y, Y[2] = S(c1) * z, Y[3] = S(c1) * x;
    Y[4] = S(c2) * x * y, Y[5] = S(c2) * y * z, Y[6] = S(c3) * (S(3) * z * z - S(1)), Y[7] = S(c2) * x * z;
    Y[8] = S(c2 / 2) * (x * x - y * y);
}
// Returns the cotangent of the vector, by forward derivatives along each axis.
inline Vec3 harmonics_vjp(Vec3 n, const double* Y_bar) {
    double along[3];
    for (int axis = 0; axis < 3; ++axis) {
        Dual Y[n_harmonics];
        harmonics(Dual(n.x, axis == 0), Dual(n.y, axis == 1), Dual(n.z, axis == 2), Y);
        along[axis] = 0;
        for (int i = 0; i < n_harmonics; ++i) along[axis] += Y_bar[i] * Y[i].dot;
    }
    return {along[0], along[1], along[2]};
}

inline void components(Vec3 n, double* out) { out[0] = n.x, out[1] = n.y, out[2] = n.z; }
inline void components(DualVec3 n, Dual* out) {
    out[0] = {n.value.x, n.dot.x}, out[1] = {n.value.y, n.dot.y}, out[2] = {n.value.z, n.dot.z};
}

// Writes the irradiance E (channels,) of a surface with the unit normal n.
template <class S>
void irradiance(const std::vector<Table>& tables, const Light& light, int channels, Vector<S> n, S* E) {
    S own[3], Y[n_harmonics];
    components(Rotation<S>::of(tables, light).from_world(n), own);
    harmonics(own[0], own[1], own[2], Y);
    for (int c = 0; c < channels; ++c) {
        E[c] = 0;
        for (int i = 0; i < n_harmonics; ++i) E[c] += Y[i] * tables[light.radiance].channel<S>(i, c);
    }
}
inline void irradiance_vjp(const std::vector<Table>& tables, const Light& light, int channels, Vec3 n,
                           const double* E_bar, Vec3& n_bar, Cotangents& to) {
    const Rotation<double> rotation = Rotation<double>::of(tables, light);
    const Vec3 own = rotation.from_world(n);
    const Table& table = tables[light.radiance];
    double Y[n_harmonics], Y_bar[n_harmonics], row_bar[most_lit_channels];
    harmonics(own.x, own.y, own.z, Y);
    for (int i = 0; i < n_harmonics; ++i) {
        Y_bar[i] = 0;
        for (int c = 0; c < channels; ++c)
            Y_bar[i] += E_bar[c] * table.channel<double>(i, c), row_bar[c] = E_bar[c] * Y[i];
        to.add_channels(light.radiance, i, table.width, channels, row_bar);
    }
    const Vec3 own_bar = harmonics_vjp(own, Y_bar);
    n_bar += rotation.to_world(own_bar);
    if (light.rotation != no_table) rotation_vjp(light, n, own_bar, to);
}

}  // namespace edgegrad
