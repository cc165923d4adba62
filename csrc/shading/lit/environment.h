// Light from all around: the same, or an image of directions (edgegrad/scene/environment.py says which).
#pragma once

#include <algorithm>
#include <cmath>

#include "shading/lit/light.h"

namespace edgegrad {

// The unit direction of a point, in the frame of the image.
inline Vec3 own_direction(const Lamp& lamp, const LightPoint& p) {
    const int64_t row = p.index / lamp.width, column = p.index % lamp.width;
    const double top = lamp.cosines[row], bottom = lamp.cosines[row + 1];
    const double y = top + p.v * (bottom - top), phi = 2 * M_PI / lamp.width * (column + p.u) - M_PI;
    const double across = std::sqrt(std::max(0.0, 1 - y * y));
    return {across * std::sin(phi), y, -across * std::cos(phi)};
}

// The point at a unit direction of the world.
inline LightPoint point_towards(const std::vector<Table>& tables, const Lamp& lamp, Vec3 direction) {
    const Vec3 d = unit(Rotation<double>::of(tables, lamp).from_world(direction));
    const auto cell = [](double x, int64_t n) { return std::clamp<int64_t>(int64_t(x), 0, n - 1); };
    const int64_t row = cell(std::acos(std::clamp(d.y, -1.0, 1.0)) * (lamp.height / M_PI), lamp.height);
    const double top = lamp.cosines[row], bottom = lamp.cosines[row + 1];
    const double turn = (std::atan2(d.x, -d.z) / (2 * M_PI) + 0.5) * lamp.width;
    const int64_t column = cell(turn, lamp.width), index = row * lamp.width + column;
    return {index, std::clamp(turn - column, 0.0, 1.0), std::clamp((d.y - top) / (bottom - top), 0.0, 1.0),
            lamp.density[index]};
}

// The same direction, or, where it lies below a surface with the normal g, its mirror image above: each stands for
// both.
inline LightPoint above(const std::vector<Table>& tables, const Lamp& lamp, const LightPoint& p, Vec3 g) {
    const Vec3 d = unit(Rotation<double>::of(tables, lamp).to_world(own_direction(lamp, p)));
    const double cosine = dot(d, g);
    LightPoint mirrored = point_towards(tables, lamp, d - 2 * cosine * g), chosen = cosine < 0 ? mirrored : p;
    chosen.density = p.density + mirrored.density;
    return chosen;
}

// Calls visit(texel, its weight) for the texels around a place in the image, which counts texels: bilinear between
// their centres, around the whole turn.
template <class Visit>
void each_texel(const Lamp& lamp, double column, double row, Visit visit) {
    column -= 0.5, row -= 0.5;
    const double c0 = std::floor(column), r0 = std::floor(row), a = column - c0, b = row - r0;
    for (int i = 0; i < 4; ++i) {
        const int64_t r = std::clamp<int64_t>(int64_t(r0) + i / 2, 0, lamp.height - 1),
                      c = (int64_t(c0) + i % 2 + lamp.width) % lamp.width;
        visit(r * lamp.width + c, (i % 2 ? a : 1 - a) * (i / 2 ? b : 1 - b));
    }
}

// Those around a point.
template <class Visit>
void each_texel(const Lamp& lamp, const LightPoint& p, Vec3 own, Visit visit) {
    if (!lamp.is_image) return visit(0, 1.0);
    const double row = std::atan2(std::hypot(own.x, own.z), own.y) / M_PI * lamp.height;
    each_texel(lamp, double(p.index % lamp.width) + p.u, row, visit);
}

// About how bright the image is there, for the choice of points alone.
inline double brightness(const Lamp& lamp, const LightPoint& p) {
    if (!lamp.is_image) return lamp.brightness[0];
    double sum = 0;
    each_texel(lamp, double(p.index % lamp.width) + p.u, double(p.index / lamp.width) + p.v,
               [&](int64_t texel, double weight) { sum += weight * lamp.brightness[texel]; });
    return sum;
}

template <class S>
Arriving<S> from_environment(const std::vector<Table>& tables, const Lamp& lamp, int channels, const LightPoint& p) {
    Arriving<S> o;
    const Vec3 own = own_direction(lamp, p);
    o.l = lamp.rotation == no_table ? Vector<S>(own) : unit(Rotation<S>::of(tables, lamp).to_world(Vector<S>(own)));
    std::fill(o.E, o.E + channels, S(0));
    each_texel(lamp, p, own, [&](int64_t texel, double weight) {
        for (int c = 0; c < channels; ++c) o.E[c] += S(weight / p.density) * tables[lamp.radiance].channel<S>(texel, c);
    });
    return o;
}
inline void from_environment_vjp(const std::vector<Table>& tables, const Lamp& lamp, int channels, const LightPoint& p,
                                 const Arriving<double>& bar, Cotangents& to) {
    const Vec3 own = own_direction(lamp, p);
    double row_bar[most_lit_channels];
    each_texel(lamp, p, own, [&](int64_t texel, double weight) {
        for (int c = 0; c < channels; ++c) row_bar[c] = weight / p.density * bar.E[c];
        to.add_channels(lamp.radiance, texel, tables[lamp.radiance].width, channels, row_bar);
    });
    if (lamp.rotation == no_table) return;
    rotation_vjp(lamp, unit_vjp(Rotation<double>::of(tables, lamp).to_world(own), bar.l), own, to);
}

}  // namespace edgegrad
