// Evaluates environment light: constant radiance, or an image of directions as edgegrad/scene/environment.py defines
// it. pdfs are with respect to solid angle.
#pragma once

#include <algorithm>
#include <cmath>

#include "shading/lit/light.h"
#include "texture/texture.h"

namespace edgegrad {

// Returns the unit direction of a point in the frame of the image.
inline Vec3 own_direction(const Light& light, const LightPoint& p) {
    const int64_t row = p.index / light.width, column = p.index % light.width;
    const double top = light.cosines[row], bottom = light.cosines[row + 1];
    const double y = top + p.v * (bottom - top), phi = 2 * M_PI / light.width * (column + p.u) - M_PI;
    const double across = std::sqrt(std::max(0.0, 1 - y * y));
    return {across * std::sin(phi), y, -across * std::cos(phi)};
}

// Returns the point at a unit direction of the world.
inline LightPoint point_towards(const std::vector<Table>& tables, const Light& light, Vec3 direction) {
    const Vec3 d = unit(Rotation<double>::of(tables, light).from_world(direction));
    const auto cell = [](double x, int64_t n) { return std::clamp<int64_t>(int64_t(x), 0, n - 1); };
    const int64_t row = cell(std::acos(std::clamp(d.y, -1.0, 1.0)) * (light.height / M_PI), light.height);
    const double top = light.cosines[row], bottom = light.cosines[row + 1];
    const double turn = (std::atan2(d.x, -d.z) / (2 * M_PI) + 0.5) * light.width;
    const int64_t column = cell(turn, light.width), index = row * light.width + column;
    return {index, std::clamp(turn - column, 0.0, 1.0), std::clamp((d.y - top) / (bottom - top), 0.0, 1.0),
            light.pdf[index]};
}

// Returns the point, or its mirror image if it lies below a surface with the normal g. Its pdf is the sum of both.
inline LightPoint above(const std::vector<Table>& tables, const Light& light, const LightPoint& p, Vec3 g) {
    const Vec3 d = unit(Rotation<double>::of(tables, light).to_world(own_direction(light, p)));
    const double cosine = dot(d, g);
    LightPoint mirrored = point_towards(tables, light, d - 2 * cosine * g), chosen = cosine < 0 ? mirrored : p;
    chosen.pdf = p.pdf + mirrored.pdf;
    return chosen;
}

// Calls visit(texel, its weight) for the texels around a position in texels. Weights are bilinear between texel
// centres, and columns wrap around.
template <class Visit>
void each_texel(const Light& light, double column, double row, Visit visit) {
    column -= 0.5, row -= 0.5;
    const double c0 = std::floor(column), r0 = std::floor(row);
    const TexelGrid grid{0, light.height, light.width, {Wrap::repeat, Wrap::clamp}};
    const Footprint f = footprint_at(grid, c0, r0, column - c0, row - r0);
    for (int i = 0; i < 4; ++i) visit(f.texel[i], f.weight(i));
}

// Calls visit(texel, its weight) for the texels around a point.
template <class Visit>
void each_texel(const Light& light, const LightPoint& p, Vec3 own, Visit visit) {
    if (!light.is_image) return visit(0, 1.0);
    const double row = std::atan2(std::hypot(own.x, own.z), own.y) / M_PI * light.height;
    each_texel(light, double(p.index % light.width) + p.u, row, visit);
}

// Returns the approximate brightness of the image, for sampling only.
inline double brightness(const Light& light, const LightPoint& p) {
    if (!light.is_image) return light.brightness[0];
    double sum = 0;
    each_texel(light, double(p.index % light.width) + p.u, double(p.index / light.width) + p.v,
               [&](int64_t texel, double weight) { sum += weight * light.brightness[texel]; });
    return sum;
}

template <class S>
Arriving<S> from_environment(const std::vector<Table>& tables, const Light& light, int channels, const LightPoint& p) {
    Arriving<S> o;
    const Vec3 own = own_direction(light, p);
    o.l = light.rotation == no_table ? Vector<S>(own) : unit(Rotation<S>::of(tables, light).to_world(Vector<S>(own)));
    std::fill(o.E, o.E + channels, S(0));
    each_texel(light, p, own, [&](int64_t texel, double weight) {
        for (int c = 0; c < channels; ++c) o.E[c] += S(weight / p.pdf) * tables[light.radiance].channel<S>(texel, c);
    });
    return o;
}
inline void from_environment_vjp(const std::vector<Table>& tables, const Light& light, int channels,
                                 const LightPoint& p, const Arriving<double>& bar, Cotangents& to) {
    const Vec3 own = own_direction(light, p);
    double row_bar[most_lit_channels];
    each_texel(light, p, own, [&](int64_t texel, double weight) {
        for (int c = 0; c < channels; ++c) row_bar[c] = weight / p.pdf * bar.E[c];
        to.add_channels(light.radiance, texel, tables[light.radiance].width, channels, row_bar);
    });
    if (light.rotation == no_table) return;
    rotation_vjp(light, unit_vjp(Rotation<double>::of(tables, light).to_world(own), bar.l), own, to);
}

}  // namespace edgegrad
