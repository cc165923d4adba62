// Defines a light, a point on it, and what all kinds of lights share. punctual.h, area.h, environment.h and
// spherical_harmonics.h evaluate what arrives at a surface from a point of each kind, and the _vjp.
#pragma once

#include <algorithm>
#include <cstdint>

#include "shading/lit/source.h"

namespace edgegrad {

class EmissiveFaceTree;

struct Light {
    enum class Kind { directional, point, spot, mesh, environment, harmonics };
    Kind kind = Kind::point;
    // Each table has one row, except the radiance of an environment, whose rows are texels.
    int position = no_table, direction = no_table, intensity = no_table, color = no_table;
    int inner_angle = no_table, outer_angle = no_table, rotation = no_table, radiance = no_table;
    int mesh = -1;                  // This mesh emits.
    int64_t height = 1, width = 1;  // size of the environment's image
    bool is_image = false;          // Without an image, radiance is the same in all directions.
    // Lights with an extent have the running sum of the probabilities of their faces or texels, and the pdfs.
    const double *running = nullptr, *pdf = nullptr;
    int64_t size = 0;
    // A mesh has a tree of its faces if glossy surfaces sample it. `hides` says that no face is alpha-tested, so near
    // faces occlude far ones.
    const EmissiveFaceTree* tree = nullptr;
    bool hides = true;
    // Says whether directions to a bounding sphere usually hit the light, and its emission is about even.
    bool is_round = false;
    // An environment has the brightness of its texels, none of it zero, and the cosines of its rows' borders. A mesh
    // has one number that is added to its brightness, which keeps it above zero.
    const double *brightness = nullptr, *cosines = nullptr;
    uint64_t stream[3] = {};  // The light, its lobes, and the choice each have a random stream.
    double eps = 0;           // relative spacing of positions on the light

    bool is_infinite() const {
        return kind == Kind::directional || kind == Kind::environment || kind == Kind::harmonics;
    }
    bool is_punctual() const { return kind != Kind::mesh && kind != Kind::environment; }
    bool casts() const { return kind != Kind::harmonics; }
};

// Identifies a point by coordinates that stay fixed while the light moves. They are a face and its last two
// barycentrics, or a texel and the position in it.
struct LightPoint {
    int64_t index = 0;
    double u = 0, v = 0, pdf = 1;

    bool exists() const { return pdf > 0; }
};

// Selects one of the parts first … first + n − 1 of a running sum of probabilities, each `step` wide. `within` is the
// position of the number u in [0, 1) inside that part, uniform as well.
struct PickedPart {
    int64_t part;
    double within;
};
inline PickedPart pick(const double* running, int64_t first, int64_t n, int64_t step, double u) {
    const auto before = [&](int64_t k) { return k == 0 ? 0.0 : running[k * step - 1]; };
    const double start = before(first), at = start + u * (before(first + n) - start);
    int64_t low = first, high = first + n - 1;  // The part lies in this range.
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (at < before(middle + 1)) high = middle;
        else low = middle + 1;
    }
    const double mass = before(low + 1) - before(low);
    return {low, mass > 0 ? std::clamp((at - before(low)) / mass, 0.0, 1.0) : 0.5};
}

// Samples a point from numbers in [0, 1); close numbers give close points. Environments select row, then column.
inline LightPoint draw(const Light& light, Vec2 u) {
    if (light.is_punctual()) return {};
    if (light.kind == Light::Kind::environment) {
        const PickedPart row = pick(light.running, 0, light.height, light.width, u.x);
        const PickedPart texel = pick(light.running, row.part * light.width, light.width, 1, u.y);
        return {texel.part, texel.within, row.within, light.pdf[texel.part]};
    }
    const PickedPart face = pick(light.running, 0, light.size, 1, u.x);
    const double root = std::sqrt(face.within);  // uniform in a triangle (Turk 1990)
    return {face.part, root * (1 - u.y), root * u.y, light.pdf[face.part]};
}

// Holds the direction of arriving light, and its unoccluded irradiance at normal incidence over the point's pdf.
template <class S>
struct Arriving {
    Vector<S> l;  // unit vector
    S E[most_lit_channels];
};

// Writes intensity times colour.
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

// Returns the direction, scaled so that its square stays within the range of doubles.
template <class S>
Vector<S> direction_of(const std::vector<Table>& tables, const Light& light) {
    const Vector<S> d = tables[light.direction].vector_at<S>(0);
    const Vec3 p = plain(d);
    return 1 / std::max({std::fabs(p.x), std::fabs(p.y), std::fabs(p.z)}) * d;
}
// Adds the cotangent of the direction as given, from the cotangent of direction_of().
inline void direction_vjp(const std::vector<Table>& tables, const Light& light, Vec3 bar, Cotangents& to) {
    const Vec3 p = tables[light.direction].vector_at<double>(0);
    to.add(light.direction, 0, 1 / std::max({std::fabs(p.x), std::fabs(p.y), std::fabs(p.z)}) * bar);
}

// Rotates from the axes of an environment or of harmonics to those of the world, and back.
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
// Adds outer(rows, columns) to the cotangent of the rotation: for to_world(d), the result's cotangent and d.
inline void rotation_vjp(const Light& light, Vec3 rows, Vec3 columns, Cotangents& to) {
    const double r[3] = {rows.x, rows.y, rows.z}, c[3] = {columns.x, columns.y, columns.z};
    double bar[9];
    for (int i = 0; i < 9; ++i) bar[i] = r[i / 3] * c[i % 3];
    to.add(light.rotation, 0, bar);
}

}  // namespace edgegrad
