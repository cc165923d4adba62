// The kernel without Python under ThreadSanitizer: two threads of the program render at once, each as one of four that
// share its work, the same and different geometry, while vertices move and calls are interrupted.
//
//     threads PATH_OF_LIBEMBREE4 [race]
//
// Each image and gradient must have the bits that it has alone. With `race`, the threads of a loop add to one number,
// which must be reported.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <numbers>
#include <numeric>
#include <thread>
#include <vector>

#include "backward/backward.h"
#include "forward/lit_image.h"

using namespace edgegrad;

namespace {

const Spacing spacing{{0}, {1e-7}};

constexpr int width = 96, height = 64, channels = 3, team_size = 4, rounds = 6;

// The arrays of a scene: meshes with colours of vertices, and one with a texture, among them.
template <class T>
struct Scene {
    std::vector<double> verts;
    std::vector<int32_t> faces, corners, face_texture;
    std::vector<T> colors, texels, background;
    std::vector<double> uvs{0.1, 0.0, 1.2, 0.1, 1.1, 0.9, -0.1, 1.0};
    std::vector<int64_t> textures{0, 16, 8, 0, 0, 0};

    Scene() : texels(16 * 8 * channels), background(width * height * channels) {
        for (size_t i = 0; i < texels.size(); ++i) texels[i] = T(hash(i, 1, 1) % 256) / 255;
        for (size_t i = 0; i < background.size(); ++i) background[i] = T(i % 7) / 7;
    }

    void add_vertex(Vec3 p) {
        for (const double x : {p.x, p.y, p.z}) verts.push_back(x), colors.push_back(T(0.5 + 0.3 * std::sin(5 * x)));
    }
    // A row of `corners` is one of colors, that of the vertex, or of uvs.
    void add_face(int32_t a, int32_t b, int32_t c, int32_t texture = -1, int32_t first = 0) {
        for (const int32_t v : {a, b, c}) faces.push_back(v), corners.push_back(v - first);
        face_texture.push_back(texture);
    }

    void add_sphere(Vec3 centre, double radius, int rows) {
        const int32_t first = int32_t(verts.size() / 3), columns = 2 * rows;
        for (int i = 0; i <= rows; ++i)
            for (int j = 0; j < columns; ++j) {
                const double theta = std::numbers::pi * i / rows, phi = 2 * std::numbers::pi * j / columns;
                add_vertex(centre + radius * Vec3{std::sin(theta) * std::cos(phi), std::cos(theta),
                                                  std::sin(theta) * std::sin(phi)});
            }
        for (int i = 0; i < rows; ++i)
            for (int j = 0; j < columns; ++j) {
                const int32_t a = first + i * columns + j, b = first + i * columns + (j + 1) % columns;
                add_face(a, b, b + columns), add_face(a, b + columns, a + columns);
            }
    }

    void add_box(Vec3 centre, double half) {
        const int32_t first = int32_t(verts.size() / 3);
        for (int i = 0; i < 8; ++i)
            add_vertex(centre + half * Vec3{i & 1 ? 1. : -1., i & 2 ? 1. : -1., i & 4 ? 1. : -1.});
        for (const auto& [a, b, c, d] :
             {std::array{0, 1, 3, 2}, {4, 6, 7, 5}, {0, 4, 5, 1}, {2, 3, 7, 6}, {0, 2, 6, 4}, {1, 5, 7, 3}}) {
            add_face(first + a, first + b, first + c), add_face(first + a, first + c, first + d);
        }
    }

    void add_textured_quad(double z, double half) {
        const int32_t first = int32_t(verts.size() / 3);
        for (const auto& [x, y] : {std::array{-1., -1.}, {1., -1.}, {1., 1.}, {-1., 1.}})
            add_vertex({x * half, y * half, z + 0.1 * x});
        add_face(first, first + 1, first + 2, 0, first), add_face(first, first + 2, first + 3, 0, first);
    }

    SceneView<T> view() const {
        return {verts.data(),
                int64_t(verts.size() / 3),
                faces.data(),
                int64_t(faces.size() / 3),
                corners.data(),
                colors.data(),
                int64_t(colors.size() / channels),
                uvs.data(),
                int64_t(uvs.size() / 2),
                texels.data(),
                int64_t(texels.size() / channels),
                textures.data(),
                face_texture.data(),
                background.data(),
                true,
                channels,
                &spacing};
    }
};

Camera camera(bool perspective) {
    const double pose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1};
    const double f = perspective ? 70 : 25, K[9] = {f, 0, width / 2., 0, f, height / 2., 0, 0, 1};
    return Camera(pose, K, perspective, width, height);
}

thread_local bool stop = false;

// The scene, of one material, before a point of light.
template <class T>
struct Lit {
    double eye[3], position[3] = {1, 0.5, -2.5}, intensity = 7;
    LitScene scene;

    Lit(const SceneView<T>& view, const Camera& camera) : eye{0, 0, camera.perspective ? -3. : -1.} {
        scene.tables = {
            {view.verts, true, view.n_verts, 3}, {eye, true, 1, 3}, {position, true, 1, 3}, {&intensity, true, 1, 1}};
        LitMesh mesh;
        mesh.faces = view.n_faces, mesh.has_material = true;
        scene.meshes = {mesh};
        Light light;
        light.kind = Light::Kind::point, light.position = 2, light.intensity = 3, light.eps = 1e-7;
        scene.lights = {light};
        scene.faces = view.faces, scene.verts = 0, scene.eye = 1, scene.perspective = camera.perspective;
        scene.channels = channels, scene.radius = 4;
    }
};

// Returns the image and all gradients, one after the other.
template <class T>
std::vector<double> render(const Scene<T>& scene, const Camera& camera, FilterKind filter, int spp, ThreadTeam& team) {
    const SceneView<T> view = scene.view();
    std::vector<T> image(width * height * channels), coverage(width * height);
    std::vector<float> depth(width * height);
    std::vector<int32_t> hit(2 * width * height);
    std::vector<uint8_t> seen(view.n_faces);
    std::vector<double> all;
    GeometryWork work;
    const HitBuffers<T> hits{coverage.data(), depth.data(), hit.data(), seen.data()};
    const ImageOptions options{spp, Filter(filter), 1};
    {
        const auto geometry =
            acquire_geometry(view.faces, view.n_faces, view.verts, view.n_verts, spacing, {}, team, work);
        const Lit<T> lit(view, camera);
        const LitImage<T> lit_image = render_lit(lit.scene, view, camera, geometry->caster(), options, LitOptions(),
                                                 LitSampling{1, 3, 4}, team, hits);
        all.assign(lit_image.radiance.begin(), lit_image.radiance.end());
        render_forward(view, camera, geometry->caster(), options, team, image.data(), hits);
    }
    std::vector<double> verts(scene.verts.size()), colors(scene.colors.size()), uvs(scene.uvs.size()),
        texels(scene.texels.size()), background(scene.background.size()), pose(16), K(9);
    const Gradients grad{.verts = verts.data(),
                         .colors = colors.data(),
                         .uvs = uvs.data(),
                         .texels = texels.data(),
                         .background = background.data(),
                         .world_to_camera = pose.data(),
                         .K = K.data()};
    const auto geometry = acquire_geometry(view.faces, view.n_faces, view.verts, view.n_verts, spacing,
                                           geometry_for(true, true), team, work);
    render_backward(BackwardInput<T>{view, camera, *geometry, options, image.data(), hits}, {.seed = 2}, team, grad);
    if (!(*std::max_element(all.begin(), all.end()) > 0)) std::puts("the lit image is black"), std::exit(1);
    all.insert(all.end(), image.begin(), image.end());
    for (const auto* values : {&verts, &colors, &uvs, &texels, &background, &pose, &K}) {
        const double size = std::inner_product(values->begin(), values->end(), values->begin(), 0.0);
        if (!(size > 0) || !std::isfinite(size)) std::puts("a gradient is zero or not finite"), std::exit(1);
        all.insert(all.end(), values->begin(), values->end());
    }
    return all;
}

template <class T>
std::vector<double> render(const Scene<T>& scene, const Camera& camera, FilterKind filter, int spp) {
    ThreadTeam team(team_size, [] { return stop; });
    std::vector<double> all;
    team.run([&] { all = render(scene, camera, filter, spp, team); });
    return all;
}

// Round k of either thread: another position every second round.
template <class T>
std::vector<double> round(Scene<T> scene, int k) {
    for (size_t i = 0; i < scene.verts.size(); i += 3) scene.verts[i] += 0.05 * (k / 2);
    return render(scene, camera(k % 2 == 0), FilterKind(k % 3), 8);
}

// A call that ends early, as by Ctrl-C; uninterrupted it would take seconds.
template <class T>
void interrupted_call(const Scene<T>& scene) {
    stop = true;
    try {
        render(scene, camera(true), FilterKind::box, 1 << 12);
        std::puts("a call was not interrupted"), std::exit(1);
    } catch (const Interrupted&) {
    }
    stop = false;
}

template <class T>
bool same_bits_at_once(const Scene<T>& a, const Scene<T>& b) {
    std::vector<std::vector<double>> alone[2], found[2];
    for (int k = 0; k < rounds; ++k) alone[0].push_back(round(a, k)), alone[1].push_back(round(b, k));
    const auto run = [&](int i) {
        for (int k = 0; k < rounds; ++k) {
            found[i].push_back(round(i ? b : a, k));
            if (k % 3 == i) interrupted_call(i ? b : a);
        }
        clear_geometry();
    };
    std::thread first(run, 0), second(run, 1);
    first.join(), second.join();
    for (int i = 0; i < 2; ++i)
        for (int k = 0; k < rounds; ++k)
            if (std::memcmp(alone[i][k].data(), found[i][k].data(), alone[i][k].size() * sizeof(double)) != 0) {
                std::printf("round %d of thread %d: other bits than alone\n", k, i);
                return false;
            }
    return true;
}

template <class T>
bool same_bits_at_once() {
    Scene<T> scene, other;
    scene.add_textured_quad(1.5, 1.6), scene.add_sphere({0.3, 0.1, 0}, 0.8, 40), scene.add_box({-0.6, -0.2, 0}, 0.5);
    other.add_box({0.4, 0.3, -0.3}, 0.4), other.add_sphere({0, 0, 0.2}, 0.7, 70), other.add_textured_quad(0.5, 1.0);
    return same_bits_at_once(scene, scene) && same_bits_at_once(scene, other);
}

}  // namespace

int main(int argc, char** argv) {
    if (argc > 2 && std::strcmp(argv[2], "race") == 0) {
        int sum = 0;
        ThreadTeam(team_size).parallel_for(100, [&](int64_t) {
            std::this_thread::sleep_for(std::chrono::milliseconds(1));  // the others are awake by then
            ++sum;
        });
        return std::printf("%d\n", sum) < 0;
    }
    if (argc != 2) return std::puts("usage: threads PATH_OF_LIBEMBREE4 [race]"), 2;
    open_embree(argv[1]);
    return same_bits_at_once<float>() && same_bits_at_once<double>() ? 0 : 1;
}
