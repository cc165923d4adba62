#include "shading/lit/lit.h"

#include <algorithm>
#include <limits>

#include "forward/trace.h"
#include "shading/lit/environment.h"
#include "shading/lit/punctual.h"
#include "shading/lit/scattering.h"
#include "shading/lit/spherical_harmonics.h"

namespace edgegrad {

namespace {

// A point of a surface that light falls on.
template <class S>
struct Surface {
    const LitMesh* mesh;
    FacePoint<S> at;
    FaceFrame<Vector<S>> frame;
    Vector<S> y, v;  // place, and the unit direction to the viewer
    Vector<S> g, n;  // unit normals of the face and for shading, on the viewer's side
    double side;     // 1 in front of the face, or −1
    Scattering<S> scattering;

    bool is_black() const { return side < 0 && mesh->has_material && !mesh->two_sided; }
};

template <class S>
Vector<S> towards_viewer(const LitScene& lit, Vector<S> y) {
    const Vector<S> eye = lit.tables[lit.eye].vector_at<S>(0);
    return lit.perspective ? unit(eye - y) : eye;
}

// Written in place: it is large, and its scattering comes later.
template <class S>
void set_surface(const LitScene& lit, int64_t face, const S* b, Surface<S>& o) {
    const std::vector<Table>& tables = lit.tables;
    o.mesh = &lit.mesh_of(face);
    o.at = {face - o.mesh->first_face, lit.faces + 3 * face, o.mesh->first_vertex, {b[0], b[1], b[2]}};
    o.y = Vector<S>();
    for (int i = 0; i < 3; ++i) {
        o.frame.corner[i] = tables[lit.verts].vector_at<S>(o.at.vertex[i]);
        o.y += o.at.b[i] * o.frame.corner[i];
    }
    o.frame.g = unit(cross(o.frame.corner[1] - o.frame.corner[0], o.frame.corner[2] - o.frame.corner[0]));
    o.v = towards_viewer<S>(lit, o.y);
    o.side = dot(plain(o.frame.g), plain(o.v)) >= 0 ? 1 : -1;
    o.g = o.side * o.frame.g;
    o.n = o.mesh->normal.is_flat() ? o.g : o.side * shading_normal(tables, o.mesh->normal, o.at, o.frame);
}

// The base colour, and what else scatters.
constexpr double plain_color = 0.7;  // of a mesh without colours (PLAIN in edgegrad/mesh.py)
template <class S>
void look_up_material(const LitScene& lit, Surface<S>& o) {
    const LitMesh& mesh = *o.mesh;
    const int C = lit.channels;
    Scattering<S>& s = o.scattering;
    if (mesh.color.exists()) value(lit.tables, mesh.color, o.at, C, s.base);
    else std::fill(s.base, s.base + C, S(mesh.base.exists() ? 1 : plain_color));
    if (mesh.base.exists()) {
        S factor[most_lit_channels];
        value(lit.tables, mesh.base, o.at, C, factor);
        for (int c = 0; c < C; ++c) s.base[c] *= factor[c];
    }
    s.lambertian = mesh.lambertian;
    s.metallic = 0, s.roughness = 1;
    if (mesh.metallic.exists()) value(lit.tables, mesh.metallic, o.at, 1, &s.metallic);
    if (mesh.roughness.exists()) value(lit.tables, mesh.roughness, o.at, 1, &s.roughness);
}

// Cotangents of what a point is made of.
struct SurfaceBar {
    Vec3 y, v, g, n;
    Scattering<double> scattering;
    double emission[most_lit_channels];
    FaceFrame<Vec3> frame;
    double b[3] = {};

    explicit SurfaceBar(int channels) {
        std::fill(scattering.base, scattering.base + channels, 0.0);
        scattering.metallic = scattering.roughness = 0;
    }
};

void look_up_material_vjp(const LitScene& lit, const Surface<double>& o, SurfaceBar& bar, Cotangents& to) {
    const LitMesh& mesh = *o.mesh;
    const int C = lit.channels;
    const Scattering<double>& s_bar = bar.scattering;
    const double* color_bar = s_bar.base;
    double of_color[most_lit_channels];
    if (mesh.base.exists()) {
        double own[most_lit_channels], factor[most_lit_channels], factor_bar[most_lit_channels];
        if (mesh.color.exists()) value(lit.tables, mesh.color, o.at, C, own);
        else std::fill(own, own + C, 1.0);
        value(lit.tables, mesh.base, o.at, C, factor);
        for (int c = 0; c < C; ++c) factor_bar[c] = s_bar.base[c] * own[c], of_color[c] = s_bar.base[c] * factor[c];
        value_vjp(lit.tables, mesh.base, o.at, C, factor_bar, bar.b, to);
        color_bar = of_color;
    }
    if (mesh.color.exists()) value_vjp(lit.tables, mesh.color, o.at, C, color_bar, bar.b, to);
    if (mesh.metallic.exists()) value_vjp(lit.tables, mesh.metallic, o.at, 1, &s_bar.metallic, bar.b, to);
    if (mesh.roughness.exists()) value_vjp(lit.tables, mesh.roughness, o.at, 1, &s_bar.roughness, bar.b, to);
}

// From the cotangents of place, view and normals to those of barycentrics, vertices, normals and eye.
void surface_vjp(const LitScene& lit, const Surface<double>& o, SurfaceBar& bar, Cotangents& to) {
    const std::vector<Table>& tables = lit.tables;
    if (o.mesh->normal.is_flat()) bar.g += bar.n;
    else shading_normal_vjp(tables, o.mesh->normal, o.at, o.frame, o.side * bar.n, bar.frame, bar.b, to);
    bar.frame.g += o.side * bar.g;
    if (o.scattering.lambertian) {
        // Looks the same from everywhere.
    } else if (lit.perspective) {
        const Vec3 towards_bar = unit_vjp(tables[lit.eye].vector_at<double>(0) - o.y, bar.v);
        to.add(lit.eye, 0, towards_bar), bar.y -= towards_bar;
    } else {
        to.add(lit.eye, 0, bar.v);
    }
    const Vec3* p = o.frame.corner;
    const Vec3 e1 = p[1] - p[0], e2 = p[2] - p[0];
    Vec3 e1_bar, e2_bar;
    cross_vjp(e1, e2, unit_vjp(cross(e1, e2), bar.frame.g), e1_bar, e2_bar);
    bar.frame.corner[0] -= e1_bar + e2_bar, bar.frame.corner[1] += e1_bar, bar.frame.corner[2] += e2_bar;
    for (int i = 0; i < 3; ++i) {
        bar.b[i] += dot(bar.y, p[i]);
        to.add(lit.verts, o.at.vertex[i], bar.frame.corner[i] + o.at.b[i] * bar.y);
    }
}

template <class S>
Arriving<S> arriving(const LitScene& lit, const Lamp& lamp, const LightPoint& point, Vector<S> y) {
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return from_direction<S>(lit.tables, lamp, lit.channels);
        case Lamp::Kind::environment:
            return from_environment<S>(lit.tables, lamp, lit.channels, point);
        case Lamp::Kind::mesh:
            return from_faces<S>(lit.tables, lit.emitter(lamp), point, lit.channels, y);
        default:
            return from_point<S>(lit.tables, lamp, lit.channels, y);
    }
}
void arriving_vjp(const LitScene& lit, const Lamp& lamp, const LightPoint& point, Vec3 y, const Arriving<double>& bar,
                  Vec3& y_bar, Cotangents& to) {
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return from_direction_vjp(lit.tables, lamp, lit.channels, bar, to);
        case Lamp::Kind::environment:
            return from_environment_vjp(lit.tables, lamp, lit.channels, point, bar, to);
        case Lamp::Kind::mesh:
            return from_faces_vjp(lit.tables, lit.emitter(lamp), point, lit.channels, y, bar, y_bar, to);
        default:
            return from_point_vjp(lit.tables, lamp, lit.channels, y, bar, y_bar, to);
    }
}

// The place of a point of a light; of one at infinity, the unit direction towards it.
Vec3 place(const LitScene& lit, const Lamp& lamp, const LightPoint& p) {
    const std::vector<Table>& tables = lit.tables;
    switch (lamp.kind) {
        case Lamp::Kind::directional:
            return -unit(direction_of<double>(tables, lamp));
        case Lamp::Kind::environment:
            return unit(Rotation<double>::of(tables, lamp).to_world(own_direction(lamp, p)));
        case Lamp::Kind::mesh: {
            const EmissiveFaces from = lit.emitter(lamp);
            const FacePoint<double> at = on_emitter<double>(from, p);
            Vec3 sum;
            for (int i = 0; i < 3; ++i) sum += at.b[i] * tables[lit.verts].vector_at<double>(at.vertex[i]);
            return sum;
        }
        default:
            return tables[lamp.position].vector_at<double>(0);
    }
}

// The point of a light that point i of a surface with the normal g is lit by.
LightPoint light_point(const LitScene& lit, const LitPoints& points, int64_t i, const LightSample& which, Vec3 g) {
    const Lamp& lamp = lit.lamps[which.lamp];
    if (lamp.is_punctual()) return {};
    const ForcedLight& forced = points.forced;
    if (forced.lamp == which.lamp) return {forced.index[i], forced.uv[2 * i], forced.uv[2 * i + 1], forced.density[i]};
    // Numbers that fill the unit cube evenly (edgegrad/_seeds.py).
    const uint64_t seed = uint64_t(points.seed[i]) * uint64_t(which.count) + uint64_t(which.sample);
    double u[3];
    for (int k = 0; k < 3; ++k) u[k] = double((seed * lit.step[k] + lamp.stream[k]) >> 11) * 0x1p-53;
    const LightPoint p = draw(lamp, u);
    return lamp.kind == Lamp::Kind::environment ? above(lit.tables, lamp, p, g) : p;
}

// What one light sample adds, before it is known to be seen: f E max(0, n·l).
template <class S>
void add_light(const LitScene& lit, const Lamp& lamp, const LightPoint& point, double share, const Surface<S>& o,
               S* total) {
    const Arriving<S> a = arriving<S>(lit, lamp, point, o.y);
    S f[most_lit_channels];
    scatter(o.scattering, o.v, o.n, a.l, lit.channels, f);
    S cosine = S(share) * dot(o.n, a.l);
    if (!o.mesh->normal.is_flat()) cosine *= terminator<S>(o.g, o.n, a.l);
    for (int c = 0; c < lit.channels; ++c) total[c] += f[c] * a.E[c] * cosine;
}
void add_light_vjp(const LitScene& lit, const Lamp& lamp, const LightPoint& point, double share,
                   const Surface<double>& o, const double* total_bar, SurfaceBar& bar, Cotangents& to) {
    const Arriving<double> a = arriving<double>(lit, lamp, point, o.y);
    double f[most_lit_channels], f_bar[most_lit_channels];
    scatter(o.scattering, o.v, o.n, a.l, lit.channels, f);
    const double nl = dot(o.n, a.l), t = o.mesh->normal.is_flat() ? 1 : terminator<double>(o.g, o.n, a.l);
    Arriving<double> a_bar;
    double cosine_bar = 0;
    for (int c = 0; c < lit.channels; ++c) {
        cosine_bar += total_bar[c] * f[c] * a.E[c];
        f_bar[c] = total_bar[c] * a.E[c] * share * nl * t, a_bar.E[c] = total_bar[c] * f[c] * share * nl * t;
    }
    scatter_vjp(o.scattering, o.v, o.n, a.l, lit.channels, f_bar, bar.scattering, bar.v, bar.n, a_bar.l);
    dot_vjp(o.n, a.l, cosine_bar * share * t, bar.n, a_bar.l);
    if (!o.mesh->normal.is_flat()) terminator_vjp(o.g, o.n, a.l, cosine_bar * share * nl, bar.g, bar.n, a_bar.l);
    arriving_vjp(lit, lamp, point, o.y, a_bar, bar.y, to);
}

// Everything but lights that cast shadows.
template <class S>
void add_unshadowed(const LitScene& lit, const Surface<S>& o, S* total) {
    if (!o.mesh->has_material) {
        for (int c = 0; c < lit.channels; ++c) total[c] += o.scattering.base[c];
        return;
    }
    S own[most_lit_channels];
    if (o.mesh->emission.exists()) {
        value(lit.tables, o.mesh->emission, o.at, lit.channels, own);
        for (int c = 0; c < lit.channels; ++c) total[c] += own[c];
    }
    for (const Lamp& lamp : lit.lamps) {
        if (lamp.casts()) continue;
        irradiance<S>(lit.tables, lamp, lit.channels, o.n, own);
        for (int c = 0; c < lit.channels; ++c) total[c] += S(1 / M_PI) * o.scattering.diffuse(c) * own[c];
    }
}
void add_unshadowed_vjp(const LitScene& lit, const Surface<double>& o, const double* total_bar, SurfaceBar& bar,
                        Cotangents& to) {
    if (!o.mesh->has_material) {
        for (int c = 0; c < lit.channels; ++c) bar.scattering.base[c] += total_bar[c];
        return;
    }
    if (o.mesh->emission.exists()) value_vjp(lit.tables, o.mesh->emission, o.at, lit.channels, total_bar, bar.b, to);
    double E[most_lit_channels], E_bar[most_lit_channels];
    for (const Lamp& lamp : lit.lamps) {
        if (lamp.casts()) continue;
        irradiance<double>(lit.tables, lamp, lit.channels, o.n, E);
        for (int c = 0; c < lit.channels; ++c) {
            E_bar[c] = total_bar[c] / M_PI * o.scattering.diffuse(c);
            diffuse_vjp(o.scattering, c, total_bar[c] / M_PI * E[c], bar.scattering);
        }
        irradiance_vjp(lit.tables, lamp, lit.channels, o.n, E_bar, bar.n, to);
    }
}

// Radiance at a point of which it is known which lights it sees.
template <class S>
void radiance(const LitScene& lit, const LitPoints& points, const LitOptions& options,
              const std::vector<LightSample>& lights, int64_t i, const Surface<S>& o, const int8_t* seen, S* total) {
    std::fill(total, total + lit.channels, S(0));
    if (o.is_black()) return;
    if (options.only < 0) add_unshadowed(lit, o, total);
    for (size_t k = 0; k < lights.size(); ++k)
        if (seen[k] > 0)
            add_light<S>(lit, lit.lamps[lights[k].lamp], light_point(lit, points, i, lights[k], plain(o.g)),
                         1.0 / lights[k].count, o, total);
}
// Whether no light that a point sees, nor anything else, gives it radiance: then it has no derivatives either.
bool is_unlit(const LitScene& lit, int64_t face, const int8_t* seen, size_t lights) {
    const LitMesh& mesh = lit.mesh_of(face);
    if (!mesh.has_material || mesh.emission.exists()) return false;
    return std::none_of(seen, seen + lights, [](int8_t s) { return s > 0; }) &&
           std::all_of(lit.lamps.begin(), lit.lamps.end(), [](const Lamp& lamp) { return lamp.casts(); });
}
void radiance_vjp(const LitScene& lit, const LitPoints& points, const LitOptions& options,
                  const std::vector<LightSample>& lights, int64_t i, Surface<double>& o, const int8_t* seen,
                  const double* total_bar, double* b_bar, Cotangents& to) {
    if (o.is_black() || is_unlit(lit, points.face[i], seen, lights.size())) return;
    look_up_material(lit, o);
    SurfaceBar bar(lit.channels);
    if (options.only < 0) add_unshadowed_vjp(lit, o, total_bar, bar, to);
    for (size_t k = 0; k < lights.size(); ++k)
        if (seen[k] > 0)
            add_light_vjp(lit, lit.lamps[lights[k].lamp], light_point(lit, points, i, lights[k], o.g),
                          1.0 / lights[k].count, o, total_bar, bar, to);
    look_up_material_vjp(lit, o, bar, to);
    surface_vjp(lit, o, bar, to);
    std::copy(bar.b, bar.b + 3, b_bar);
}

// Shadow rays from points to points of lights.
struct ShadowRays {
    std::vector<int32_t> face;
    std::vector<double> b, to, contact;
    std::vector<int8_t*> result;

    void clear() { face.clear(), b.clear(), to.clear(), contact.clear(), result.clear(); }
    void add(const LitScene& lit, const Lamp& lamp, int64_t face_, const Surface<double>& o, Vec3 there, int8_t* seen) {
        const auto largest = [](Vec3 v) { return std::max({std::fabs(v.x), std::fabs(v.y), std::fabs(v.z)}); };
        double size = largest(o.y);
        if (lamp.is_infinite()) there = o.y + (length(o.y - lit.center) + 1.01 * lit.radius) * there;
        else size = std::max(size, largest(there));
        face.push_back(int32_t(face_)), result.push_back(seen), contact.push_back(16 * lamp.eps * size);
        b.insert(b.end(), {o.at.b[1], o.at.b[2]}), to.insert(to.end(), {there.x, there.y, there.z});
    }
    template <class T>
    void cast(const SceneView<T>& scene, const RayCaster& caster, std::vector<uint8_t>& found) {
        found.resize(face.size());
        see(scene, caster, {face.data(), b.data(), to.data(), contact.data(), int64_t(face.size())}, found.data());
        for (size_t k = 0; k < found.size(); ++k) *result[k] = int8_t(found[k]);
        clear();
    }
};

}  // namespace

const LitMesh& LitScene::mesh_of(int64_t face) const {
    size_t k = 0;
    while (k + 1 < meshes.size() && face >= meshes[k + 1].first_face) ++k;
    return meshes[k];
}

std::vector<LightSample> light_samples(const LitScene& lit, const LitOptions& options) {
    std::vector<LightSample> out;
    for (int k = 0; k < int(lit.lamps.size()); ++k) {
        if (!lit.lamps[k].casts() || !(options.only < 0 || options.only == k)) continue;
        const int count = lit.lamps[k].is_punctual() ? 1 : options.samples;
        for (int s = 0; s < count; ++s) out.push_back({k, s, count});
    }
    return out;
}

struct ShadeRoom {
    std::vector<LightSample> lights;
    std::vector<Surface<double>> surfaces;
    ShadowRays rays;
    std::vector<uint8_t> found;
};
std::shared_ptr<ShadeRoom> shade_room(const LitScene& lit, const LitOptions& options) {
    auto room = std::make_shared<ShadeRoom>();
    room->lights = light_samples(lit, options);
    return room;
}

namespace {

// Finds the surfaces at points, and which lights they see; of points that are `wanted`.
template <class T, class Wanted>
void look(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
          const LitOptions& options, ShadeRoom& room, int8_t* seen, Wanted wanted) {
    const std::vector<LightSample>& lights = room.lights;
    const size_t K = lights.size();
    room.surfaces.resize(points.size);
    for (int64_t i = 0; i < points.size; ++i)
        if (wanted(i)) set_surface<double>(lit, points.face[i], points.b + 3 * i, room.surfaces[i]);
    // Light by light, for rays that are cast together are the faster the more alike they are.
    for (size_t k = 0; k < K; ++k) {
        const Lamp& lamp = lit.lamps[lights[k].lamp];
        const Vec3 only_place = lamp.is_punctual() ? place(lit, lamp, {}) : Vec3();
        for (int64_t i = 0; i < points.size; ++i) {
            if (!wanted(i)) continue;
            const Surface<double>& o = room.surfaces[i];
            int8_t& found = seen[i * K + k] = not_asked;
            if (!o.mesh->has_material || o.is_black()) continue;
            const Vec3 there =
                lamp.is_punctual() ? only_place : place(lit, lamp, light_point(lit, points, i, lights[k], o.g));
            const Vec3 l = lamp.is_infinite() ? there : unit(there - o.y);
            if (!(dot(o.n, l) > 0 && dot(o.g, l) > 0)) continue;
            found = 1;
            if (!options.shadows) continue;
            if (points.forced.lamp == lights[k].lamp) found = int8_t(points.forced.lit[i]);
            else room.rays.add(lit, lamp, points.face[i], o, there, &found);
        }
    }
    room.rays.cast(scene, caster, room.found);
}

}  // namespace

template <class T>
void shade_some(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
                const LitOptions& options, ShadeRoom& room, double* radiance_out, int8_t* seen) {
    look(lit, scene, caster, points, options, room, seen, [](int64_t) { return true; });
    for (int64_t i = 0; radiance_out && i < points.size; ++i) {
        look_up_material(lit, room.surfaces[i]);
        radiance<double>(lit, points, options, room.lights, i, room.surfaces[i], seen + i * room.lights.size(),
                         radiance_out + i * lit.channels);
    }
}

template <class T>
void shade(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitPoints& points,
           const LitOptions& options, double* radiance_out, int8_t* seen, Team& team) {
    const size_t K = light_samples(lit, options).size();
    team.each_with((points.size + shaded_at_once - 1) / shaded_at_once, [&] { return shade_room(lit, options); },
                   [&](ShadeRoom& room, int64_t block) {
                       const int64_t first = block * shaded_at_once;
                       shade_some(lit, scene, caster, points.part(first, shaded_at_once), options, room,
                                  radiance_out ? radiance_out + first * lit.channels : nullptr, seen + first * K);
                   });
}

namespace {

// Calls body(first, last, cotangents) for chunks of points, and adds these up.
template <class Body>
void add_cotangents(const LitScene& lit, int64_t points, const std::vector<TableBar>& to, Team& team, Body body) {
    std::vector<Cotangents> chunks;
    double seconds[2] = {};
    scatter_in_waves(
        team, points, chunks, [&](Cotangents& chunk, int owners) { chunk.prepare(lit.tables, to, owners); }, body,
        [&](const Cotangents& chunk, int owner) { chunk.add_to(to, owner); }, [](Cotangents&) {}, seconds);
}

}  // namespace

void shade_vjp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               const double* bar, const std::vector<TableBar>& to, double* b_bar, Team& team) {
    const std::vector<LightSample> lights = light_samples(lit, options);
    std::fill(b_bar, b_bar + 3 * points.size, 0.0);
    add_cotangents(lit, points.size, to, team, [&](int64_t first, int64_t last, Cotangents& chunk) {
        for (int64_t i = first; i < last; ++i) {
            Surface<double> o;
            set_surface<double>(lit, points.face[i], points.b + 3 * i, o);
            radiance_vjp(lit, points, options, lights, i, o, seen + i * lights.size(), bar + i * lit.channels,
                         b_bar + 3 * i, chunk);
        }
    });
}

template <class T>
void look_and_shade_vjp(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster,
                        const LitPoints& points, const LitOptions& options, const double* bar,
                        const std::vector<TableBar>& to, double* b_bar, Team& team) {
    std::fill(b_bar, b_bar + 3 * points.size, 0.0);
    add_cotangents(lit, points.size, to, team, [&](int64_t first, int64_t last, Cotangents& chunk) {
        const auto room = shade_room(lit, options);
        const size_t K = room->lights.size();
        std::vector<int8_t> seen(shaded_at_once * K);
        for (; first < last; first += shaded_at_once) {
            const LitPoints some = points.part(first, std::min(shaded_at_once, last - first));
            // What the loss ignores needs no look, for its derivatives are zero.
            const auto wanted = [&](int64_t i) {
                const double* of_point = bar + (first + i) * lit.channels;
                return std::any_of(of_point, of_point + lit.channels, [](double x) { return x != 0; });
            };
            look(lit, scene, caster, some, options, *room, seen.data(), wanted);
            for (int64_t i = 0; i < some.size; ++i)
                if (wanted(i))
                    radiance_vjp(lit, some, options, room->lights, i, room->surfaces[i], seen.data() + i * K,
                                 bar + (first + i) * lit.channels, b_bar + 3 * (first + i), chunk);
        }
    });
}

void shade_jvp(const LitScene& lit, const LitPoints& points, const LitOptions& options, const int8_t* seen,
               const double* b_dot, double* radiance_dot, Team& team) {
    const std::vector<LightSample> lights = light_samples(lit, options);
    team.each_block(points.size, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t i = first; i < last; ++i) {
            Dual b[3], total[most_lit_channels];
            for (int k = 0; k < 3; ++k) b[k] = {points.b[3 * i + k], b_dot ? b_dot[3 * i + k] : 0};
            Surface<Dual> o;
            set_surface<Dual>(lit, points.face[i], b, o);
            look_up_material(lit, o);
            radiance<Dual>(lit, points, options, lights, i, o, seen + i * lights.size(), total);
            for (int c = 0; c < lit.channels; ++c) radiance_dot[i * lit.channels + c] = total[c].dot;
        }
    });
}

template void shade_some(const LitScene&, const SceneView<float>&, const RayCaster&, const LitPoints&,
                         const LitOptions&, ShadeRoom&, double*, int8_t*);
template void shade_some(const LitScene&, const SceneView<double>&, const RayCaster&, const LitPoints&,
                         const LitOptions&, ShadeRoom&, double*, int8_t*);
template void shade(const LitScene&, const SceneView<float>&, const RayCaster&, const LitPoints&, const LitOptions&,
                    double*, int8_t*, Team&);
template void shade(const LitScene&, const SceneView<double>&, const RayCaster&, const LitPoints&, const LitOptions&,
                    double*, int8_t*, Team&);
template void look_and_shade_vjp(const LitScene&, const SceneView<float>&, const RayCaster&, const LitPoints&,
                                 const LitOptions&, const double*, const std::vector<TableBar>&, double*, Team&);
template void look_and_shade_vjp(const LitScene&, const SceneView<double>&, const RayCaster&, const LitPoints&,
                                 const LitOptions&, const double*, const std::vector<TableBar>&, double*, Team&);

}  // namespace edgegrad
