#include "python/lit_arrays.h"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <memory>
#include <string>
#include <utility>

#include "python/shaped.h"
#include "shading/lit/light_sample.h"
#include "shading/lit/mesh_light_sampling.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

// Returns the index of a name in a list. Raises ValueError.
template <class Kind>
Kind kind_of(const char* argument, const std::string& name, const std::vector<std::string>& names) {
    for (size_t i = 0; i < names.size(); ++i)
        if (names[i] == name) return Kind(i);
    refuse(std::string(argument) + ": unknown kind \"" + name + "\"");
}

const int32_t* data_of(const std::optional<Rows>& rows) { return rows ? rows->data() : nullptr; }

SourceArrays make_source(const std::string& kind, int value, int factor, int uvs, std::optional<Rows> uv_faces,
                         int64_t height, int64_t width, const std::vector<int>& sampler, int levels) {
    if (sampler.size() != 3) refuse("sampler: expected the wrap of u and of v, and the filter");
    const Source source{kind_of<Source::Kind>("kind", kind, {"constant", "vertex", "face", "corner", "texture"}),
                        value,
                        uvs,
                        factor,
                        data_of(uv_faces),
                        height,
                        width,
                        {Wrap(sampler[0]), Wrap(sampler[1]), TextureFilter(sampler[2])},
                        levels};
    return {source, uv_faces};
}

MeshArrays make_mesh(int64_t first_face, int64_t faces, int32_t first_vertex, bool has_material, bool two_sided,
                     bool lambertian, const SourceArrays& color, const SourceArrays& base, const SourceArrays& metallic,
                     const SourceArrays& roughness, const SourceArrays& emission, const SourceArrays& normal_map,
                     int normal_scale, const SourceArrays& tangents, int normals, std::optional<Rows> normal_faces) {
    LitMesh mesh{first_face, faces,     first_vertex,  has_material,   two_sided,     lambertian,
                 color.view, base.view, metallic.view, roughness.view, emission.view, {}};
    mesh.normal = {normals, data_of(normal_faces), normal_map.view, normal_scale, tangents.view};
    return {mesh, {color, base, metallic, roughness, emission, normal_map, tangents}, normal_faces};
}

LightArrays make_light(const std::string& kind, int position, int direction, int intensity, int color, int inner_angle,
                       int outer_angle, int rotation, int radiance, int mesh, int64_t height, int64_t width,
                       bool is_image, std::optional<In<double, 1>> running, std::optional<In<double, 1>> pdf,
                       std::optional<In<double, 1>> brightness, std::optional<In<double, 1>> cosines,
                       std::shared_ptr<EmissiveFaceTree> tree, bool hides, const std::vector<uint64_t>& stream,
                       double eps) {
    Light light;
    light.kind = kind_of<Light::Kind>("kind", kind,
                                      {"directional", "point", "spot", "mesh", "environment", "spherical harmonics"});
    light.position = position, light.direction = direction, light.intensity = intensity, light.color = color;
    light.inner_angle = inner_angle, light.outer_angle = outer_angle, light.rotation = rotation,
    light.radiance = radiance;
    light.mesh = mesh, light.height = height, light.width = width, light.is_image = is_image, light.eps = eps;
    if (!light.is_punctual()) {
        if (!running || !pdf || running->size() != pdf->size() || running->size() == 0)
            refuse("running, pdf: expected a number for each face or texel");
        light.running = running->data(), light.pdf = pdf->data(), light.size = int64_t(running->size());
    }
    if (light.kind == Light::Kind::environment) {
        if (!brightness || int64_t(brightness->size()) != light.size || light.size != height * width)
            refuse("brightness: expected a number for each texel");
        if (!cosines || int64_t(cosines->size()) != height + 1) refuse("cosines: expected one more than rows");
        light.brightness = brightness->data(), light.cosines = cosines->data();
    }
    light.tree = tree.get(), light.hides = hides;
    if (light.kind == Light::Kind::mesh) {
        if (!brightness || brightness->size() != 1) refuse("brightness: expected one number");
        light.brightness = brightness->data();
        light.is_round = tree && is_round(*tree, light.pdf, light.size);
    }
    if (stream.size() != std::size(light.stream)) refuse("stream: expected three numbers");
    std::copy(stream.begin(), stream.end(), light.stream);
    return {light, {running, pdf, brightness, cosines}, tree};
}

std::shared_ptr<EmissiveFaceTree> make_tree(In<double, 2> verts, Rows faces) {
    if (verts.shape(1) != 3 || faces.shape(1) != 3 || faces.shape(0) == 0)
        refuse("verts, faces: expected three columns, and a face");
    check_indices("faces", faces.data(), faces.size(), verts.shape(0), "verts", 1);
    return std::make_shared<EmissiveFaceTree>(verts.data(), int64_t(verts.shape(0)), faces.data(),
                                              int64_t(faces.shape(0)));
}

// Returns what rays (N, 3) cross between `start` and `end` (N,), in lengths of their directions. The arrays are ray and
// face (M, 2), and barycentrics and distance (M, 3), ray after ray.
nb::tuple crossings(const EmissiveFaceTree& tree, In<double, 2> origins, In<double, 2> directions, In<double, 1> start,
                    In<double, 1> end) {
    const size_t n = origins.shape(0);
    if (origins.shape(1) != 3 || directions.shape(1) != 3 || directions.shape(0) != n || start.size() != n ||
        end.size() != n)
        refuse("origins, directions, start, end: expected a row a ray");
    std::vector<int64_t> which;
    std::vector<double> where;
    for (size_t i = 0; i < n; ++i) {
        const double *o = origins.data() + 3 * i, *d = directions.data() + 3 * i;
        tree.each_hit({o[0], o[1], o[2]}, {d[0], d[1], d[2]}, start(i), end(i), [&](const EmissiveFaceTree::Hit& c) {
            which.insert(which.end(), {int64_t(i), c.face}), where.insert(where.end(), {c.u, c.v, c.t});
            return end(i);
        });
    }
    const size_t m = which.size() / 2;
    return nb::make_tuple(shaped(std::move(which), {m, 2}), shaped(std::move(where), {m, 3}));
}

}  // namespace

LitArrays::LitArrays(std::vector<AnyTable> tables, std::vector<MeshArrays> meshes, std::vector<LightArrays> lights,
                     Rows faces, int verts, int eye, bool perspective, int channels, const std::vector<double>& ball)
    : tables_(std::move(tables)), meshes_(std::move(meshes)), lights_(std::move(lights)), faces_(faces) {
    if (channels < 1 || channels > most_lit_channels) refuse("channels: expected 1 to 16");
    if (ball.size() != 4) refuse("ball: expected 4 numbers");
    for (const AnyTable& t : tables_) {
        const bool wide = t.dtype() == nb::dtype<double>();
        if (!wide && t.dtype() != nb::dtype<float>()) refuse("tables: expected floats or doubles");
        scene.tables.push_back({t.data(), wide, int64_t(t.shape(0)), int(t.shape(1))});
    }
    scene.faces = faces_.data(), scene.verts = verts, scene.eye = eye, scene.perspective = perspective;
    scene.channels = channels, scene.center = {ball[0], ball[1], ball[2]}, scene.radius = ball[3];
    check_table("verts", verts, 1, 3), check_table("eye", eye, 1, 3);
    if (faces.shape(1) != 3) refuse("faces: expected three columns");
    check_indices("faces", faces.data(), faces.size(), size_t(table(verts).rows), "verts", 1);
    for (const MeshArrays& mesh : meshes_) check_mesh(mesh), scene.meshes.push_back(mesh.view);
    for (const LightArrays& light : lights_) check_light(light.view), scene.lights.push_back(light.view);
}

void LitArrays::check_table(const char* name, int number, int64_t rows, int columns) const {
    if (number < 0 || size_t(number) >= scene.tables.size()) refuse(std::string(name) + ": expected a table");
    if (table(number).rows < rows || (columns && table(number).width != columns))
        refuse(std::string(name) + ": expected a table of " + std::to_string(columns) + " columns and at least " +
               std::to_string(rows) + " rows");
}
void LitArrays::check_channels(const char* name, int number, int64_t rows, int channels) const {
    check_table(name, number, rows, 0);
    if (const int n = table(number).width; n != 1 && n != channels)
        refuse(std::string(name) + ": expected 1 or " + std::to_string(channels) + " columns, got " +
               std::to_string(n));
}
void LitArrays::check_index(const char* name, const int32_t* index, int64_t faces, int number) const {
    if (!index) refuse(std::string(name) + ": expected three indices a face");
    check_indices(name, index, size_t(3 * faces), size_t(table(number).rows), "the table", 1);
}
void LitArrays::check_source(const char* name, const SourceArrays& arrays, const LitMesh& mesh, int channels) const {
    const Source& s = arrays.view;
    if (!s.exists()) return;
    using Kind = Source::Kind;
    check_channels(name, s.value,
                   s.kind == Kind::face     ? mesh.faces
                   : s.kind == Kind::corner ? 3 * mesh.faces
                                            : 1,
                   channels);
    if (s.factor != no_table) check_channels(name, s.factor, 1, channels);
    if (s.kind == Kind::vertex)
        for (int64_t f = 3 * mesh.first_face; f < 3 * (mesh.first_face + mesh.faces); ++f)
            if (const int64_t row = int64_t(faces_.data()[f]) - mesh.first_vertex;
                row < 0 || row >= table(s.value).rows)
                refuse(std::string(name) + ": expected a row for each vertex of the mesh");
    if (s.kind != Kind::texture) return;
    const bool there = s.height >= 1 && s.width >= 1 && s.levels >= 1 && s.levels <= 64;
    const TexelGrid behind = there ? s.grid(s.levels) : TexelGrid{-1, 0, 0};
    if (behind.first != table(s.value).rows) refuse(std::string(name) + ": expected a row for each texel");
    check_table(name, s.uvs, 1, 2);
    if (!arrays.uv_faces || int64_t(arrays.uv_faces->shape(0)) != mesh.faces || arrays.uv_faces->shape(1) != 3)
        refuse(std::string(name) + ": expected uv_faces with a row for each face");
    check_index(name, s.uv_faces, mesh.faces, s.uvs);
}
void LitArrays::check_mesh(const MeshArrays& arrays) const {
    const LitMesh& m = arrays.view;
    if (m.first_face < 0 || m.faces < 1 || m.first_face + m.faces > int64_t(faces_.shape(0)))
        refuse("meshes: expected faces of the scene");
    const char* names[] = {"color", "base_color", "metallic", "roughness", "emission", "normal_map", "tangents"};
    const int channels[] = {scene.channels, scene.channels, 1, 1, scene.channels, 3, 4};
    for (int i = 0; i < 7; ++i) check_source(names[i], arrays.kept[size_t(i)], m, channels[i]);
    if (m.normal.map.exists()) {
        check_table("normal_scale", m.normal.map_scale, 1, 1);
        if (m.normal.map.kind != Source::Kind::texture) refuse("normal_map: expected a texture");
        if (m.normal.tangents.exists()) check_table("tangents", m.normal.tangents.value, 3 * m.faces, 4);
    }
    if (m.normal.normals == no_table) return;
    check_table("normals", m.normal.normals, 1, 3);
    if (!arrays.normal_faces || int64_t(arrays.normal_faces->shape(0)) != m.faces || arrays.normal_faces->shape(1) != 3)
        refuse("normal_faces: expected a row for each face");
    check_index("normal_faces", m.normal.normal_faces, m.faces, m.normal.normals);
}
void LitArrays::check_light(const Light& light) const {
    using Kind = Light::Kind;
    const auto optional = [&](const char* name, int number, int64_t rows, int columns) {
        if (number != no_table) check_table(name, number, rows, columns);
    };
    optional("rotation", light.rotation, 1, 9);
    if (light.kind == Kind::directional || light.kind == Kind::point || light.kind == Kind::spot) {
        check_table("intensity", light.intensity, 1, 1);
        if (light.color != no_table) check_channels("color", light.color, 1, scene.channels);
    }
    if (light.kind == Kind::point || light.kind == Kind::spot) check_table("position", light.position, 1, 3);
    if (light.kind == Kind::directional || light.kind == Kind::spot) check_table("direction", light.direction, 1, 3);
    if (light.kind == Kind::spot)
        check_table("inner_angle", light.inner_angle, 1, 1), check_table("outer_angle", light.outer_angle, 1, 1);
    if (light.kind == Kind::harmonics) check_channels("coefficients", light.radiance, 9, scene.channels);
    if (light.kind == Kind::environment) {
        if (light.height < 1 || light.width < 1 || light.height * light.width != light.size)
            refuse("radiance: expected a pdf for each texel");
        check_channels("radiance", light.radiance, light.is_image ? light.size : 1, scene.channels);
    }
    if (light.kind != Kind::mesh) return;
    if (light.mesh < 0 || size_t(light.mesh) >= scene.meshes.size()) refuse("mesh: expected one of the scene");
    if (light.size != scene.meshes[size_t(light.mesh)].faces || !scene.meshes[size_t(light.mesh)].emission.exists())
        refuse("mesh: expected one that emits, and a pdf for each of its faces");
    if (light.tree && light.tree->n_faces() != light.size) refuse("tree: expected that of the mesh");
}

LitPoints PointArrays::view(const LitScene& scene, int64_t faces) const {
    const size_t n = face.size();
    if (b.shape(0) != n || b.shape(1) != 3 || seed.size() != n) refuse("b, seed: expected a row a point");
    for (size_t i = 0; i < n; ++i)
        if (face(i) < 0 || face(i) >= faces) refuse("face: expected faces of the scene");
    if (spread && (spread->shape(0) != n || spread->shape(1) != 2 || spread->shape(2) != 2))
        refuse("spread: expected two rows of two a point");
    LitPoints points{int64_t(n), face.data(), b.data(), seed.data(), {}, spread ? spread->data() : nullptr};
    if (forced_light < 0) return points;
    if (size_t(forced_light) >= scene.lights.size() || !index || !uv || !pdf || !lit || index->size() != n ||
        uv->shape(0) != n || uv->shape(1) != 2 || pdf->size() != n || lit->size() != n)
        refuse("forced: expected a row a point");
    const Light& light = scene.lights[size_t(forced_light)];
    for (size_t i = 0; !light.is_punctual() && i < n; ++i)
        if ((*index)(i) < 0 || (*index)(i) >= light.size) refuse("forced: expected faces or texels of the light");
    points.forced = {forced_light, index->data(), uv->data(), pdf->data(), lit->data()};
    return points;
}

void bind_lit_arrays(nb::module_& m) {
    m.attr("MOST_LIT_CHANNELS") = most_lit_channels;
    m.attr("FAINTEST_NORMAL") = faintest_normal;
    m.attr("MOST_BOUNCES") = most_bounces;
    m.attr("MOST_EMISSIVE_FACES") = EmissiveFaceTree::most_faces;
    m.attr("CANDIDATES_FOR_ONE") = candidates_for_one;
    m.attr("WIDEST_LOBE") = widest_lobe;
    m.attr("SET_SIZE") = AntitheticSet::most;
    m.attr("SETS_FOR_ONE") = sets_for_one;
    m.attr("MOST_SETS_FOR_ONE") = most_sets_for_one;
    nb::class_<SourceArrays>(m, "LitSource")
        .def(nb::new_(&make_source), "kind"_a, "value"_a = no_table, "factor"_a = no_table, "uvs"_a = no_table,
             "uv_faces"_a.noconvert() = nb::none(), "height"_a = 0, "width"_a = 0,
             "sampler"_a = std::vector<int>{0, 0, 0}, "levels"_a = 1);
    nb::class_<MeshArrays>(m, "LitMesh")
        .def(nb::new_(&make_mesh), nb::kw_only(), "first_face"_a, "faces"_a, "first_vertex"_a, "has_material"_a,
             "two_sided"_a, "lambertian"_a, "color"_a, "base_color"_a, "metallic"_a, "roughness"_a, "emission"_a,
             "normal_map"_a, "normal_scale"_a, "tangents"_a, "normals"_a, "normal_faces"_a.noconvert());
    nb::class_<LightArrays>(m, "Light")
        .def(nb::new_(&make_light), "kind"_a, nb::kw_only(), "position"_a = no_table, "direction"_a = no_table,
             "intensity"_a = no_table, "color"_a = no_table, "inner_angle"_a = no_table, "outer_angle"_a = no_table,
             "rotation"_a = no_table, "radiance"_a = no_table, "mesh"_a = -1, "height"_a = 1, "width"_a = 1,
             "is_image"_a = false, "running"_a.noconvert() = nb::none(), "pdf"_a.noconvert() = nb::none(),
             "brightness"_a.noconvert() = nb::none(), "cosines"_a.noconvert() = nb::none(), "tree"_a = nb::none(),
             "hides"_a = true, "stream"_a, "eps"_a);
    nb::class_<LitArrays>(m, "Lit").def(
        nb::init<std::vector<AnyTable>, std::vector<MeshArrays>, std::vector<LightArrays>, Rows, int, int, bool, int,
                 const std::vector<double>&>(),
        nb::kw_only(), "tables"_a, "meshes"_a, "lights"_a, "faces"_a.noconvert(), "verts"_a, "eye"_a, "perspective"_a,
        "channels"_a, "ball"_a);
    nb::class_<PointArrays>(m, "LitPoints")
        .def(nb::new_([](In<int64_t, 1> face, In<double, 2> b, In<int64_t, 1> seed, int forced_light,
                         std::optional<In<int64_t, 1>> index, std::optional<In<double, 2>> uv,
                         std::optional<In<double, 1>> pdf, std::optional<In<uint8_t, 1>> lit,
                         std::optional<In<double, 3>> spread) {
                 return PointArrays{face, b, seed, forced_light, index, uv, pdf, lit, spread};
             }),
             nb::kw_only(), "face"_a.noconvert(), "b"_a.noconvert(), "seed"_a.noconvert(), "forced_light"_a = -1,
             "index"_a.noconvert() = nb::none(), "uv"_a.noconvert() = nb::none(), "pdf"_a.noconvert() = nb::none(),
             "lit"_a.noconvert() = nb::none(), "spread"_a.noconvert() = nb::none());
    nb::class_<EmissiveFaceTree>(m, "EmissiveFaceTree")
        .def(nb::new_(&make_tree), "verts"_a.noconvert(), "faces"_a.noconvert())
        .def_prop_ro("is_flat", &EmissiveFaceTree::is_flat)
        .def_prop_ro("is_convex", &EmissiveFaceTree::is_convex)
        .def(
            "is_round",
            [](const EmissiveFaceTree& t, In<double, 1> pdf) { return is_round(t, pdf.data(), int64_t(pdf.size())); },
            "pdf"_a.noconvert())
        .def_prop_ro("ball",
                     [](const EmissiveFaceTree& t) {
                         return std::array<double, 5>{t.center().x, t.center().y, t.center().z, t.radius(), t.size()};
                     })
        .def("crossings", &crossings, "origins"_a.noconvert(), "directions"_a.noconvert(), "start"_a.noconvert(),
             "end"_a.noconvert());
    nb::class_<LitOptions>(m, "LitOptions")
        .def(nb::new_([](bool shadows, int samples, int only, bool antithetic, double dark, int bounces, double near,
                         bool only_near_field) {
                 if (bounces < 1 || bounces > most_bounces) refuse("bounces: expected 1 to MOST_BOUNCES");
                 if (!(near >= 0)) refuse("near: expected no less than 0");
                 return LitOptions{shadows, samples, only, antithetic, dark, bounces, near, only_near_field};
             }),
             nb::kw_only(), "shadows"_a, "samples"_a, "only"_a, "antithetic"_a, "dark"_a, "bounces"_a = 1,
             "near"_a = 0.0, "only_near_field"_a = false);
}

}  // namespace edgegrad
