// Bounds the memory of the passes, in bytes by part, by their owners' formulas, before anything is allocated.

#include <nanobind/nanobind.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <map>
#include <string>
#include <vector>

#include "accumulate/scatter.h"
#include "camera/sub_cameras.h"
#include "camera/vertices.h"
#include "core/ordered_draws.h"
#include "discontinuities/discontinuities.h"
#include "estimator/image_hits.h"
#include "primary/crease_faces.h"
#include "primary/curve_measure.h"
#include "primary/overlapping_parts.h"
#include "rays/geometry.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace edgegrad {

namespace {

using Bytes = std::map<std::string, int64_t>;

// Holds the sizes of a scene's arrays, of one camera's image, and the number of threads.
struct PassSize {
    int64_t verts, faces, colors, uvs, texels, alphas, pixels;
    int radiance, vertex_attributes, face_attributes;  // widths
    int channels, number;                              // image's channels, and the bytes of one number
    bool textured;
    bool jumps;  // whether adjacent faces may differ where they meet
    int threads;
    int sides;  // number of the camera's sides (sub_cameras.h)

    // Returns the number of edges of a closed mesh.
    int64_t edges() const { return 3 * faces / 2; }
};

Bytes image_bytes(const PassSize& s, int64_t cameras) {
    const int64_t pixels = cameras * s.pixels;
    return {{"image", pixels * s.channels * s.number},
            {"coverage", pixels * s.number},
            {"depth", pixels * int64_t(sizeof(float))},
            {"faces hit", pixels * 2 * int64_t(sizeof(int32_t))},
            {"faces seen", cameras * s.faces},
            {"vertices in view", s.sides * s.verts * int64_t(sizeof(Vec3))},
            {"ray structure", RayCaster::bytes(s.faces, s.verts)}};
}

// Selects the wanted parts of the gradient: what moves inside faces and at edges, and the arrays of colours.
struct GradientWork {
    bool motion, boundary, discontinuities, colors, uvs, texels, alphas, vertex_attributes, face_attributes;
    int64_t surface_samples, edge_samples, curves, intersections, discontinuity_lines;  // −1 means unknown.
};

Bytes gradient_bytes(const PassSize& s, const GradientWork& w) {
    constexpr int64_t many = int64_t(1) << 62, word = sizeof(double);
    const bool moves = w.motion || w.boundary,
               interior = w.motion || w.colors || w.uvs || w.texels || w.vertex_attributes || w.face_attributes;
    const auto rows = [&](int64_t samples, int64_t primitives, int64_t each, int width, int64_t destinations) {
        return RowBuffer::bytes({samples, primitives, each, destinations, width}, s.threads);
    };
    Bytes bytes;
    if (interior || w.boundary || w.discontinuities) {
        bytes["view"] = word * s.pixels + s.verts * (VertexView::bytes_per_vertex + 3 * word * moves);
        bytes["ray structure"] = RayCaster::bytes(s.faces, s.verts);
    }
    if (interior) {
        // First come the measure, and what controls need per vertex. Large textured faces are left to pixels.
        const int64_t per_vertex = ImageHits::bytes_per_vertex + s.channels * s.number + 2 * word * w.motion;
        bytes["faces in view"] = (word + 1) * s.faces + per_vertex * s.verts + (s.faces + word * s.pixels) * s.textured;
        bytes["controls"] = w.motion ? rows(s.faces, s.faces, 3, 2, s.verts) : 0;
        const int64_t n = w.surface_samples < 0 ? many : w.surface_samples;
        int64_t& samples = bytes["surface samples"];
        samples = OrderedDraws::bytes(w.surface_samples < 0 ? s.faces : w.surface_samples, s.faces);
        if (w.motion) samples += rows(n, s.faces, 3, 3, s.verts);
        // A face has a texture or colours, so a run of samples adds rows of one kind.
        if (w.colors) samples += rows(n, s.faces, 3, s.radiance, s.colors);
        else if (w.uvs) samples += rows(n, s.faces, 3, 2, s.uvs);
        if (w.texels) samples += rows(n, -1, 4, s.radiance, s.texels);
        if (w.vertex_attributes) samples += rows(n, s.faces, 3, s.vertex_attributes, s.verts);
        if (w.face_attributes) samples += rows(n, s.faces, 1, s.face_attributes, s.faces);
    }
    if (w.discontinuities) {
        // A line crosses a discontinuity at few points. Each moves three vertices, three texture coordinates and four
        // alphas.
        constexpr int64_t points = 4;
        const int64_t lines = w.discontinuity_lines < 0 ? many / points : w.discontinuity_lines;
        int64_t& discontinuities = bytes["discontinuities"];
        discontinuities = s.faces * lined_face_bytes;
        if (moves) discontinuities += points * rows(lines, s.faces, 3, 3, s.verts);
        if (w.uvs) discontinuities += points * rows(lines, s.faces, 3, 2, s.uvs);
        if (w.alphas) discontinuities += points * rows(lines, -1, 4, 1, s.alphas);
    }
    if (w.boundary) {
        // If all attributes are indexed like vertices, curves are silhouettes: a quarter of a tangled mesh's edges.
        const int64_t curves = w.curves < 0 ? s.edges() / (s.jumps ? 1 : 4) : w.curves;
        bytes["edges in view"] = s.faces + curves * bytes_per_curve();
        bytes["creases"] = s.jumps ? 2 * word * s.verts + int64_t(sizeof(CreaseFace)) * s.faces +
                                         (OverlappingParts::bytes_per_pixel + CellMarks::bytes_per_pixel) * s.pixels
                                   : 0;
        const int64_t lines = w.curves < 0 ? s.edges() : w.curves + w.intersections;
        bytes["edge samples"] = OrderedDraws::bytes(w.edge_samples < 0 ? lines : w.edge_samples, lines) +
                                rows(w.edge_samples < 0 ? many : w.edge_samples, lines, 6, 3, s.verts);
        bytes["topology"] = Topology::bytes(s.faces, s.edges()) + FaceTree::bytes(s.faces);
        bytes["intersections"] = Intersections::bytes(w.intersections < 0 ? s.faces / 4 : w.intersections, s.faces);
    }
    return bytes;
}

}  // namespace

void bind_memory(nb::module_& m) {
    nb::class_<PassSize>(m, "PassSize")
        .def(nb::new_([](int64_t verts, int64_t faces, int64_t colors, int64_t uvs, int64_t texels, int64_t alphas,
                         int64_t pixels, int radiance, int vertex_attributes, int face_attributes, int channels,
                         int number, bool textured, bool jumps, int threads, int sides) {
                 return PassSize{
                     verts,           faces,    colors, uvs,      texels, alphas,  pixels, radiance, vertex_attributes,
                     face_attributes, channels, number, textured, jumps,  threads, sides};
             }),
             nb::kw_only(), "verts"_a, "faces"_a, "colors"_a, "uvs"_a, "texels"_a, "alphas"_a, "pixels"_a, "radiance"_a,
             "vertex_attributes"_a, "face_attributes"_a, "channels"_a, "number"_a, "textured"_a, "jumps"_a, "threads"_a,
             "sides"_a);
    m.def("image_bytes", &image_bytes, "size"_a, "cameras"_a);
    m.def(
        "gradient_bytes",
        [](const PassSize& size, bool motion, bool boundary, bool discontinuities,
           const std::vector<std::string>& wanted, int64_t surface_samples, int64_t edge_samples, int64_t curves,
           int64_t intersections, int64_t discontinuity_lines) {
            const auto is = [&](const char* name) {
                return std::find(wanted.begin(), wanted.end(), name) != wanted.end();
            };
            return gradient_bytes(size, {motion, boundary, discontinuities, is("colors"), is("uvs"), is("texels"),
                                         is("alphas"), is("vertex_attributes"), is("face_attributes"), surface_samples,
                                         edge_samples, curves, intersections, discontinuity_lines});
        },
        "size"_a, nb::kw_only(), "motion"_a, "boundary"_a, "discontinuities"_a, "wanted"_a, "surface_samples"_a = -1,
        "edge_samples"_a = -1, "curves"_a = -1, "intersections"_a = -1, "discontinuity_lines"_a = -1);
    // Bounds the rows that samples add to the pixels around them: at most nine, for a Gaussian.
    m.def(
        "pixel_row_bytes",
        [](const PassSize& size, int64_t samples, int width) {
            const int64_t n = samples < 0 ? int64_t(1) << 62 : samples;
            return RowBuffer::bytes({n, -1, 9, size.pixels, width}, size.threads);
        },
        "size"_a, nb::kw_only(), "samples"_a, "width"_a);
}

}  // namespace edgegrad
