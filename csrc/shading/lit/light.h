// A light, one of its points, and what all kinds have in common. The kinds stand in punctual.h, area.h, environment.h
// and spherical_harmonics.h: what arrives from a point of the light at a surface, and the _vjp.
#pragma once

#include <algorithm>
#include <cstdint>

#include "shading/lit/source.h"

namespace edgegrad {

class EmissiveFaceTree;

struct Light {
    enum class Kind { directional, point, spot, mesh, environment, harmonics };
    Kind kind = Kind::point;
    // Tables; of one row, but for the radiance of an environment: its texels.
    int position = no_table, direction = no_table, intensity = no_table, color = no_table;
    int inner_angle = no_table, outer_angle = no_table, rotation = no_table, radiance = no_table;
    int mesh = -1;                  // the one that emits
    int64_t height = 1, width = 1;  // of the environment's image
    bool is_image = false;          // else the environment is the same from all around
    // Of lights with an extent: the running sum of the probabilities of faces or texels, and their pdfs.
    const double *running = nullptr, *pdf = nullptr;
    int64_t size = 0;
    // Of a mesh: its faces by where they lie, if glossy surfaces ask; whether none is alpha-tested, so that near ones
    // hide far ones.
    const EmissiveFaceTree* tree = nullptr;
    bool hides = true;
    // Whether directions to a ball around it find it, and all of it emit about evenly.
    bool is_round = false;
    // Of an environment: how bright texels are, but none is black, and the cosines of where rows begin and end. Of a
    // mesh one number, which is added to how bright it is, for the same reason.
    const double *brightness = nullptr, *cosines = nullptr;
    uint64_t stream[3] = {};  // of its random numbers: of the light, of lobes, and of the choice
    double eps = 0;           // relative spacing of places of its points

    bool is_infinite() const {
        return kind == Kind::directional || kind == Kind::environment || kind == Kind::harmonics;
    }
    bool is_punctual() const { return kind != Kind::mesh && kind != Kind::environment; }
    bool casts() const { return kind != Kind::harmonics; }
};

// By coordinates that stay while the light moves: a face and its last two barycentrics, or a texel and the place in it.
struct LightPoint {
    int64_t index = 0;
    double u = 0, v = 0, pdf = 1;

    bool exists() const { return pdf > 0; }
};

// Which of the parts first … first + n − 1 of the running sum of their probabilities, each `step` wide, a number in
// [0, 1) picks, and how far within that: uniform as well.
struct Picked {
    int64_t part;
    double within;
};
inline Picked pick(const double* running, int64_t first, int64_t n, int64_t step, double u) {
    const auto before = [&](int64_t k) { return k == 0 ? 0.0 : running[k * step - 1]; };
    const double start = before(first), at = start + u * (before(first + n) - start);
    int64_t low = first, high = first + n - 1;  // the part is one of these
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (at < before(middle + 1)) high = middle;
        else low = middle + 1;
    }
    const double mass = before(low + 1) - before(low);
    return {low, mass > 0 ? std::clamp((at - before(low)) / mass, 0.0, 1.0) : 0.5};
}

// From numbers in [0, 1), so that near ones give near points: of an environment first the row, then the column.
inline LightPoint draw(const Light& light, Vec2 u) {
    if (light.is_punctual()) return {};
    if (light.kind == Light::Kind::environment) {
        const Picked row = pick(light.running, 0, light.height, light.width, u.x);
        const Picked texel = pick(light.running, row.part * light.width, light.width, 1, u.y);
        return {texel.part, texel.within, row.within, light.pdf[texel.part]};
    }
    const Picked face = pick(light.running, 0, light.size, 1, u.x);
    const double root = std::sqrt(face.within);  // uniform in a triangle (Turk 1990)
    return {face.part, root * (1 - u.y), root * u.y, light.pdf[face.part]};
}

// What arrives at a point of a surface: from where, and how much at normal incidence over the pdf of the point of
// the light, nothing in between.
template <class S>
struct Arriving {
    Vector<S> l;  // unit
    S E[most_lit_channels];
};

// Intensity times colour.
template <class S>
void power(const std::vector<Table>& tables, const Light& light, int channels, S* out) {
    const S intensity = tables[light.intensity].at<S>(0);
    for (int c = 0; c < channels; ++c)
        out[c] = light.color == no_table ? intensity : intensity * tables[light.color].channel<S>(0, c);
}
inline void power_vjp(const std::vector<Table>& tables, const Light& light, int channels, const double* bar,
                      Cotangents& to) {
    const double intensity = tables[light.intensity].at<double>(0);
    double intensity_bar = 0, color_bar[most_lit_channels];
    for (int c = 0; c < channels; ++c) {
        intensity_bar += bar[c] * (light.color == no_table ? 1 : tables[light.color].channel<double>(0, c));
        color_bar[c] = bar[c] * intensity;
    }
    to.add(light.intensity, 0, &intensity_bar);
    if (light.color != no_table) to.add_channels(light.color, 0, tables[light.color].width, channels, color_bar);
}

// A direction of any length, whose square may be beyond the range of doubles.
template <class S>
Vector<S> direction_of(const std::vector<Table>& tables, const Light& light) {
    const Vector<S> d = tables[light.direction].vector_at<S>(0);
    const Vec3 p = plain(d);
    return 1 / std::max({std::fabs(p.x), std::fabs(p.y), std::fabs(p.z)}) * d;
}
// The cotangent of the direction as it is given, from that of direction_of().
inline void direction_vjp(const std::vector<Table>& tables, const Light& light, Vec3 bar, Cotangents& to) {
    const Vec3 p = tables[light.direction].vector_at<double>(0);
    to.add(light.direction, 0, 1 / std::max({std::fabs(p.x), std::fabs(p.y), std::fabs(p.z)}) * bar);
}

// The world's axes from those of an environment or of harmonics, and back.
template <class S>
struct Rotation {
    Vector<S> row[3];

    static Rotation of(const std::vector<Table>& tables, const Light& light) {
        if (light.rotation == no_table)
            return {{vector(S(1), S(0), S(0)), vector(S(0), S(1), S(0)), vector(S(0), S(0), S(1))}};
        const Table& t = tables[light.rotation];
        Rotation r;
        for (int i = 0; i < 3; ++i) r.row[i] = vector(t.at<S>(0, 3 * i), t.at<S>(0, 3 * i + 1), t.at<S>(0, 3 * i + 2));
        return r;
    }
    Vector<S> to_world(Vector<S> d) const { return vector(dot(row[0], d), dot(row[1], d), dot(row[2], d)); }
    Vector<S> from_world(Vector<S> d) const {
        const Vec3 axis[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
        Vector<S> sum;
        for (int i = 0; i < 3; ++i) sum += dot(d, Vector<S>(axis[i])) * row[i];
        return sum;
    }
};
// Adds outer(row_bar, d) to the cotangent of the rotation: of to_world(d) from that of the result.
inline void rotation_vjp(const Light& light, Vec3 rows, Vec3 columns, Cotangents& to) {
    const double r[3] = {rows.x, rows.y, rows.z}, c[3] = {columns.x, columns.y, columns.z};
    double bar[9];
    for (int i = 0; i < 9; ++i) bar[i] = r[i / 3] * c[i % 3];
    to.add(light.rotation, 0, bar);
}

}  // namespace edgegrad
