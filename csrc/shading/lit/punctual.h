// Evaluates lights of one point or one direction, as in glTF (KHR_lights_punctual).
#pragma once

#include "shading/lit/light.h"

namespace edgegrad {

template <class S>
Arriving<S> from_direction(const std::vector<Table>& tables, const Light& light, int channels) {
    Arriving<S> o;
    o.l = -1.0 * unit(direction_of<S>(tables, light));
    power(tables, light, channels, o.E);
    return o;
}
inline void from_direction_vjp(const std::vector<Table>& tables, const Light& light, int channels,
                               const Arriving<double>& bar, Cotangents& to) {
    if (to.wants(light.direction))
        direction_vjp(tables, light, -unit_vjp(direction_of<double>(tables, light), bar.l), to);
    power_vjp(tables, light, channels, bar.E, to);
}

// Evaluates a spot's falloff: the square of (cos θ − cos outer) / (cos inner − cos outer), clamped to [0, 1].
constexpr double least_ramp = 1e-3;  // glTF limits the denominator to this.
template <class S>
struct Cone {
    Vector<S> direction, away;  // unit vectors
    S inner, outer, cosine, scale, x;

    S ramp() const { return x * x; }
};
template <class S>
Cone<S> cone(const std::vector<Table>& tables, const Light& light, Vector<S> away) {
    Cone<S> o;
    o.direction = unit(direction_of<S>(tables, light)), o.away = unit(away), o.cosine = dot(o.away, o.direction);
    o.inner = cos(tables[light.inner_angle].at<S>(0)), o.outer = cos(tables[light.outer_angle].at<S>(0));
    const S width = o.inner - o.outer;
    o.scale = S(1) / (plain(width) < least_ramp ? S(least_ramp) : width);
    o.x = clamped((o.cosine - o.outer) * o.scale, 0, 1);
    return o;
}
inline void cone_vjp(const std::vector<Table>& tables, const Light& light, Vec3 away, double ramp_bar, Vec3& away_bar,
                     Cotangents& to) {
    const Cone<double> o = cone<double>(tables, light, away);
    if (!(o.x > 0 && o.x < 1)) return;
    const double x_bar = 2 * o.x * ramp_bar, cosine_bar = x_bar * o.scale;
    double inner_bar = 0, outer_bar = -cosine_bar;
    if (o.inner - o.outer > least_ramp) {
        const double width_bar = -x_bar * (o.cosine - o.outer) * o.scale * o.scale;
        inner_bar += width_bar, outer_bar -= width_bar;
    }
    inner_bar *= -std::sin(tables[light.inner_angle].at<double>(0));
    outer_bar *= -std::sin(tables[light.outer_angle].at<double>(0));
    to.add(light.inner_angle, 0, &inner_bar), to.add(light.outer_angle, 0, &outer_bar);
    away_bar += unit_vjp(away, cosine_bar * o.direction);
    direction_vjp(tables, light, unit_vjp(direction_of<double>(tables, light), cosine_bar * o.away), to);
}

// Returns what arrives from a point or spot light; it is zero, without a derivative, at the light itself.
template <class S>
Arriving<S> from_point(const std::vector<Table>& tables, const Light& light, int channels, Vector<S> y) {
    Arriving<S> o;
    const Vector<S> towards = tables[light.position].vector_at<S>(0) - y;
    const S squared = dot(towards, towards);
    if (!(plain(squared) > 0)) {
        std::fill(o.E, o.E + channels, S(0));
        return o;
    }
    o.l = unit(towards);
    S scale = S(1) / squared;
    if (light.kind == Light::Kind::spot) scale *= cone<S>(tables, light, -1.0 * towards).ramp();
    power(tables, light, channels, o.E);
    for (int c = 0; c < channels; ++c) o.E[c] *= scale;
    return o;
}
inline void from_point_vjp(const std::vector<Table>& tables, const Light& light, int channels, Vec3 y,
                           const Arriving<double>& bar, Vec3& y_bar, Cotangents& to) {
    const Vec3 towards = tables[light.position].vector_at<double>(0) - y;
    const double squared = dot(towards, towards);
    if (!(squared > 0)) return;
    const bool spot = light.kind == Light::Kind::spot;
    const double ramp = spot ? cone<double>(tables, light, -towards).ramp() : 1;
    double full[most_lit_channels], full_bar[most_lit_channels], scale_bar = 0;
    power(tables, light, channels, full);
    for (int c = 0; c < channels; ++c) scale_bar += bar.E[c] * full[c], full_bar[c] = bar.E[c] * ramp / squared;
    power_vjp(tables, light, channels, full_bar, to);
    Vec3 towards_bar = unit_vjp(towards, bar.l) - 2 * scale_bar * ramp / (squared * squared) * towards;
    if (spot) {
        Vec3 away_bar;
        cone_vjp(tables, light, -towards, scale_bar / squared, away_bar, to);
        towards_bar -= away_bar;
    }
    y_bar -= towards_bar;
    to.add(light.position, 0, towards_bar);
}

}  // namespace edgegrad
