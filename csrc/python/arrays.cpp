#include "python/arrays.h"

#include <algorithm>

#include "camera/sub_cameras.h"
#include "texture/texture.h"

namespace edgegrad {

namespace {

// From pairs of numbers: a vertex, and the spacing from there on.
Spacing make_spacing(const std::vector<double>& pairs) {
    Spacing spacing{{}, {}};
    for (size_t i = 0; i + 1 < pairs.size(); i += 2)
        spacing.first.push_back(int32_t(pairs[i])), spacing.value.push_back(pairs[i + 1]);
    if (pairs.empty() || pairs.size() % 2 || spacing.first[0] != 0 ||
        !std::is_sorted(spacing.first.begin(), spacing.first.end()))
        refuse("spacing: expected pairs of a vertex and a spacing, ascending from vertex 0");
    return spacing;
}

AnyLens make_lens(const std::string& name, In<double, 2> K, In<double, 1> distortion) {
    if (distortion.size() != most_coefficients) refuse("distortion: expected 8 numbers");
    check_finite("distortion", distortion.data(), most_coefficients, most_coefficients, 1);
    if (name == "pinhole") return PinholeLens();
    if (name == "brown-conrady") return BrownConrady(distortion.data());
    if (name == "fisheye") return Fisheye(distortion.data());
    if (name == "panorama") return Equirectangular(K.data(), {}, {});
    refuse("lens: expected \"pinhole\", \"brown-conrady\", \"fisheye\" or \"panorama\", got \"" + name + "\"");
}

}  // namespace

ChannelArrays::ChannelArrays(In<double, 2> vertex_, In<double, 2> face_, bool alpha, bool barycentrics, bool uv,
                             int unit)
    : vertex(vertex_),
      face(face_),
      view{alpha, vertex.data(), int(vertex.shape(1)), unit, face.data(), int(face.shape(1)), barycentrics, uv} {
    if (face.shape(1) > Attributes::most_of_face) refuse("face_attributes: expected at most 4 columns");
    if (unit < -1 || (unit >= 0 && unit + 3 > view.vertex_width))
        refuse("unit: expected -1, or the first of three columns of vertex_attributes");
}

template <class T>
SceneArrays<T>::SceneArrays(In<double, 2> verts_, In<int32_t, 2> faces_, In<int32_t, 2> corners_, In<T, 2> colors_,
                            In<double, 2> uvs_, In<T, 2> texels_, In<int64_t, 2> textures_,
                            In<int32_t, 1> face_texture_, In<int32_t, 2> uv_corners_, In<T, 2> alphas_,
                            In<int64_t, 2> alpha_masks_, In<int32_t, 1> face_alpha_mask_, In<T, 3> background_,
                            const std::vector<double>& cutoffs_, const std::vector<double>& spacing_, int threads)
    : verts(verts_),
      faces(faces_),
      corners(corners_),
      colors(colors_),
      uvs(uvs_),
      texels(texels_),
      textures(textures_),
      face_texture(face_texture_),
      uv_corners(uv_corners_),
      alphas(alphas_),
      alpha_masks(alpha_masks_),
      face_alpha_mask(face_alpha_mask_),
      background(background_),
      cutoffs(cutoffs_),
      spacing(make_spacing(spacing_)) {
    const auto width = [](const char* name, size_t got, size_t expected) {
        if (got != expected)
            refuse(std::string(name) + ": expected " + std::to_string(expected) + " columns, got " +
                   std::to_string(got));
    };
    const size_t R = colors.shape(1);
    width("verts", verts.shape(1), 3), width("faces", faces.shape(1), 3), width("corners", corners.shape(1), 3);
    width("uvs", uvs.shape(1), 2), width("texels", texels.shape(1), R);
    width("textures", textures.shape(1), texture_columns);
    width("uv_corners", uv_corners.shape(1), 3), width("alpha", alphas.shape(1), 1);
    width("alpha_masks", alpha_masks.shape(1), texture_columns);
    if (corners.shape(0) != faces.shape(0)) refuse("corners: expected one row a face");
    if (faces.shape(0) == 0 || verts.shape(0) == 0) refuse("faces: expected at least one face, got none");
    check_finite("verts", verts.data(), verts.size(), 3, threads);
    check_finite("colors", colors.data(), colors.size(), R, threads);
    check_finite("uvs", uvs.data(), uvs.size(), 2, threads);
    check_finite("texture", texels.data(), texels.size(), R, threads);
    check_finite("alpha", alphas.data(), alphas.size(), 1, threads);
    check_finite("background", background.data(), background.size(), background.shape(2), threads);
    check_indices("faces", faces.data(), faces.size(), verts.shape(0), "verts", threads);
    check_alpha_masks(threads);
    const bool textured = textures.shape(0) > 0;
    if (!textured) {
        // Colours of vertices are indexed by the faces, or by a copy of them.
        by_vertex =
            colors.shape(0) >= verts.shape(0) &&
            (corners.data() == faces.data() || std::equal(faces.data(), faces.data() + faces.size(), corners.data()));
        if (by_vertex) return;
        check_indices("colors", corners.data(), corners.size(), colors.shape(0), "colors", threads);
        return;
    }
    if (face_texture.shape(0) != faces.shape(0)) refuse("face_texture: expected one number a face");
    check_textures("textures", textures, int64_t(texels.shape(0)));
    for (size_t f = 0; f < faces.shape(0); ++f) {
        if (face_texture(f) >= int64_t(textures.shape(0)))
            refuse("face_texture: expected a texture's number, got " + std::to_string(face_texture(f)));
        const bool t = face_texture(f) >= 0;
        check_indices(t ? "uv_faces" : "colors", corners.data() + 3 * f, 3, t ? uvs.shape(0) : colors.shape(0),
                      t ? "uvs" : "colors", 1, 3 * f);
    }
}

template <class T>
SceneView<T> SceneArrays<T>::view(const ChannelArrays& channels, int threads) const {
    const Attributes& a = channels.view;
    if (a.vertex_width && channels.vertex.shape(0) != verts.shape(0))
        refuse("vertex_attributes: expected one row a vertex");
    if (a.face_width && channels.face.shape(0) != faces.shape(0)) refuse("face_attributes: expected one row a face");
    check_finite("vertex_attributes", a.vertex, channels.vertex.size(), a.vertex_width, threads);
    check_finite("face_attributes", a.face, channels.face.size(), a.face_width, threads);
    if (a.uv && !all_have_uvs()) refuse("uv: expected texture coordinates of all faces");
    return view_of(a);
}

template <class T>
std::shared_ptr<const Geometry> SceneArrays<T>::geometry(GeometryWanted wanted, ThreadTeam& team,
                                                         GeometryWork& work) const {
    return acquire_geometry(faces.data(), faces.shape(0), verts.data(), verts.shape(0), spacing, wanted, team, work);
}

template <class T>
void SceneArrays<T>::check_textures(const char* name, const In<int64_t, 2>& table, int64_t texels) const {
    for (size_t i = 0; i < table.shape(0); ++i) {
        const int64_t first = table(i, 0), h = table(i, 1), w = table(i, 2);
        if (h < 1 || w < 1 || first < 0 || first + h * w > texels)
            refuse(std::string(name) + ": row " + std::to_string(i) + " lies outside the texels");
        if (Sampler s = texture_at<T>(nullptr, table.data(), int64_t(i)).sampler;
            s.u < Wrap::repeat || s.u > Wrap::mirror || s.v < Wrap::repeat || s.v > Wrap::mirror ||
            s.filter < TextureFilter::linear || s.filter > TextureFilter::nearest)
            refuse(std::string(name) + ": row " + std::to_string(i) + " has an unknown wrap or filter");
    }
}

template <class T>
void SceneArrays<T>::check_alpha_masks(int threads) const {
    const size_t F = faces.shape(0), own = uv_corners.shape(0);
    if (own != 0 && own != F) refuse("uv_corners: expected one row a face");
    if (own != 0 && !all_pass(uv_corners.size(), threads, [&](int64_t first, int64_t last) {
            const int32_t* v = uv_corners.data();
            return std::all_of(v + first, v + last, [&](int32_t i) { return i >= -1 && i < int64_t(uvs.shape(0)); });
        }))
        refuse("uv_faces: expected indices from 0 to " + std::to_string(int64_t(uvs.shape(0)) - 1) + " (rows of uvs)");
    if (cutoffs.size() != alpha_masks.shape(0)) refuse("cutoffs: expected one number a cut-out");
    check_textures("alpha_masks", alpha_masks, int64_t(alphas.shape(0)));
    if (alpha_masks.shape(0) == 0) return;
    if (face_alpha_mask.shape(0) != F || own == 0)
        refuse("face_alpha_mask: expected one number a face, and uv_corners");
    for (size_t f = 0; f < F; ++f) {
        if (face_alpha_mask(f) >= int64_t(alpha_masks.shape(0)))
            refuse("face_alpha_mask: expected a cut-out's number, got " + std::to_string(face_alpha_mask(f)));
        for (int i = 0; i < 3; ++i)
            if (face_alpha_mask(f) >= 0 && uv_corners(f, i) < 0)
                refuse("uv_faces: expected indices from 0 to " + std::to_string(int64_t(uvs.shape(0)) - 1) +
                       " (rows of uvs), got another at " + at(3 * int64_t(f) + i, 3));
    }
}

template <class T>
bool SceneArrays<T>::all_have_uvs() const {
    if (uv_corners.shape(0) > 0)
        return std::all_of(uv_corners.data(), uv_corners.data() + uv_corners.size(),
                           [](int32_t row) { return row >= 0; });
    return textures.shape(0) > 0 && std::all_of(face_texture.data(), face_texture.data() + face_texture.size(),
                                                [](int32_t texture) { return texture >= 0; });
}

template <class T>
SceneView<T> SceneArrays<T>::view_of(const Attributes& attributes) const {
    if (background.shape(2) != colors.shape(1) + attributes.channels())
        refuse("background: expected one number for each channel");
    const int32_t* of_corners = by_vertex ? faces.data() : corners.data();  // one array: neighbours agree (may_jump)
    return {verts.data(),
            int64_t(verts.shape(0)),
            faces.data(),
            int64_t(faces.shape(0)),
            of_corners,
            colors.data(),
            int64_t(colors.shape(0)),
            uvs.data(),
            int64_t(uvs.shape(0)),
            texels.data(),
            int64_t(texels.shape(0)),
            textures.data(),
            textures.shape(0) ? face_texture.data() : nullptr,
            background.data(),
            background.shape(0) * background.shape(1) > 1,
            int(background.shape(2)),
            &spacing,
            attributes,
            int(colors.shape(1)),
            uv_corners.shape(0) ? uv_corners.data() : of_corners,
            {alphas.data(), int64_t(alphas.shape(0)), alpha_masks.data(), cutoffs.data(),
             alpha_masks.shape(0) ? face_alpha_mask.data() : nullptr}};
}

template <class T>
void HitArrays<T>::check(const SceneArrays<T>& scene, const Camera& camera) const {
    if (coverage.size() != size_t(camera.width) * camera.height) refuse("coverage: expected the size of the image");
    if (depth.size() != coverage.size()) refuse("depth: expected one number a pixel");
    if (hit.size() != 2 * coverage.size()) refuse("hit: expected two numbers a pixel");
    if (seen.size() != scene.faces.shape(0)) refuse("seen: expected one number a face");
}

Camera make_camera(In<double, 2> world_to_camera, In<double, 2> K, In<double, 1> distortion, bool perspective,
                   const std::string& lens, int width, int height, bool by_distortion) {
    if (world_to_camera.shape(0) != 4 || world_to_camera.shape(1) != 4)
        refuse("world_to_camera: expected shape (4, 4)");
    if (K.shape(0) != 3 || K.shape(1) != 3) refuse("K: expected shape (3, 3)");
    check_finite("world_to_camera", world_to_camera.data(), 16, 4, 1);
    check_finite("K", K.data(), 9, 3, 1);
    if (!perspective && lens != "pinhole") refuse("lens: expected a perspective view");
    const Camera camera(world_to_camera.data(), K.data(), perspective, width, height, make_lens(lens, K, distortion));
    if (camera.k_det == 0) refuse("K: expected focal lengths that are not zero, got a singular matrix");
    if (is_too_wide(camera)) refuse("K: expected a panorama that reaches around no more than 4 times");
    const auto* distorts = std::get_if<BrownConrady>(&camera.lens);
    if (distorts && distorts->is_identity() && !by_distortion && !camera.lens_view.end)
        return Camera(world_to_camera.data(), K.data(), perspective, width, height);
    return camera;
}

Filter make_filter(const std::string& name) {
    if (name == "box") return Filter(FilterKind::box);
    if (name == "tent") return Filter(FilterKind::tent);
    if (name == "gaussian") return Filter(FilterKind::gaussian);
    refuse("filter: expected \"box\", \"tent\" or \"gaussian\", got \"" + name + "\"");
}

ImageOptions make_image_options(int spp, const std::string& filter, uint64_t seed) {
    return {spp, make_filter(filter), seed};
}

template struct SceneArrays<float>;
template struct SceneArrays<double>;
template struct HitArrays<float>;
template struct HitArrays<double>;

}  // namespace edgegrad
