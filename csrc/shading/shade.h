// Evaluates the radiance of a face at given barycentrics, followed by its attributes. Radiance is an interpolated
// colour, or a texture at interpolated coordinates. A new material is one more file here, and a line in shade and
// shade_vjp.
#pragma once

#include <array>
#include <type_traits>
#include <vector>

#include "accumulate/gradients.h"
#include "accumulate/scatter.h"
#include "camera/face_map.h"
#include "core/channels.h"
#include "rays/alpha_mask.h"
#include "scene/scene.h"
#include "shading/attributes.h"
#include "texture/texture.h"

namespace edgegrad {

template <class T>
bool is_textured(const SceneView<T>& scene, int64_t face) {
    return scene.face_texture && scene.face_texture[face] >= 0;
}

template <class T>
Texture<T> texture_of(const SceneView<T>& scene, int64_t face) {
    return texture_at(scene.texels, scene.textures, scene.face_texture[face]);
}

// Returns whether the face's texture or alpha mask takes the nearest texel.
template <class T>
bool takes_nearest(const SceneView<T>& scene, int64_t face) {
    return (is_textured(scene, face) && texture_of(scene, face).sampler.filter == TextureFilter::nearest) ||
           (scene.alpha_masks.on(face) && alpha_of(scene, face).sampler.filter == TextureFilter::nearest);
}

// These functions return the number of all channels and of radiance channels. core/channels.h explains N.
template <int N, class T>
int channels_of(const SceneView<T>& scene) {
    return N ? all_channels<N> : scene.channels;
}
template <int N, class T>
int radiance_of(const SceneView<T>& scene) {
    return N > 0 ? N : scene.radiance;
}
template <int N, class T>
bool has_attributes(const SceneView<T>& scene) {
    return N < 0 || (N == 0 && scene.channels > scene.radiance);
}

// Writes all channels.
template <int N, class T>
void shade(const SceneView<T>& scene, int64_t face, Barycentrics b, double* out) {
    const int C = radiance_of<N>(scene);
    if (has_attributes<N>(scene)) shade_attributes(scene, face, b, out + C);
    if (is_textured(scene, face)) {
        const Texture<T> texture = texture_of(scene, face);
        eval<radiance_channels<N>>(texture, footprint(texture, interpolated_uv(scene, face, b)), C, out);
        return;
    }
    const int32_t* row = scene.corners + 3 * face;
    const T *c0 = scene.colors + int64_t(row[0]) * C, *c1 = scene.colors + int64_t(row[1]) * C,
            *c2 = scene.colors + int64_t(row[2]) * C;
    // Differences give a face of one colour exactly that colour, and derivatives of exactly zero.
    for (int c = 0; c < C; ++c) out[c] = c0[c] + b.u * (double(c1[c]) - c0[c]) + b.v * (double(c2[c]) - c0[c]);
}

// Calls visit(c, c0, c1, c2) for each channel c of an untextured face, with its values at the corners.
template <int N, class T, class Visit>
void each_corner_value(const SceneView<T>& scene, int64_t face, Visit visit) {
    const int C = radiance_of<N>(scene);
    const int32_t* row = scene.corners + 3 * face;
    const T *c0 = scene.colors + int64_t(row[0]) * C, *c1 = scene.colors + int64_t(row[1]) * C,
            *c2 = scene.colors + int64_t(row[2]) * C;
    for (int c = 0; c < C; ++c) visit(c, double(c0[c]), double(c1[c]), double(c2[c]));
    if (has_attributes<N>(scene))
        each_attribute(scene, attribute_arrays(scene), face,
                       [&](int k, double c0, double c1, double c2) { visit(C + k, c0, c1, c2); });
}

// Keeps the channels of an untextured face that are affine in the barycentrics, for a run of points. A direction is not
// affine; its channels are zero here.
template <int N>
class AffineRadiance {
   public:
    // Holds one number per channel, in pairs because processors add pairs at once.
    struct Fixed : std::array<double, (all_channels<N> + 1) / 2 * 2> {
        explicit Fixed(int) { this->fill(0); }
    };
    using Sum = std::conditional_t<N == 0, std::vector<double>, Fixed>;

    template <class T>
    void set(const SceneView<T>& scene, int64_t face) {
        if constexpr (N == 0)
            for (Sum* numbers : {&value_, &d_u_, &d_v_}) numbers->resize(scene.channels);
        each_corner_value<N>(scene, face, [&](int c, double c0, double c1, double c2) {
            value_[c] = c0, d_u_[c] = c1 - c0, d_v_[c] = c2 - c0;
        });
        if (const int d = direction_of(scene.attributes); has_attributes<N>(scene) && d >= 0)
            for (Sum* numbers : {&value_, &d_u_, &d_v_}) std::fill_n(numbers->begin() + scene.radiance + d, 3, 0.0);
    }

    // Adds the radiance of n points, given the sum of their barycentrics.
    void add_to(Sum& sum, Barycentrics b, int n) const {
        for (size_t c = 0; c < value_.size(); ++c) sum[c] += n * value_[c] + b.u * d_u_[c] + b.v * d_v_[c];
    }

   private:
    Sum value_ = Sum(0), d_u_ = Sum(0), d_v_ = Sum(0);
};

// Sums cotangents of a face's corners (colours, or texture coordinates; attributes) over a run of samples.
struct CornerGrad {
    int width = 0;
    std::vector<double> value, attributes;  // Their shapes are (3, width) and (3, attributes).

    template <class T>
    void reset(const SceneView<T>& scene, int64_t face) {
        width = is_textured(scene, face) ? 2 : scene.radiance;
        value.assign(3 * size_t(width), 0.0), attributes.assign(3 * size_t(scene.channels - scene.radiance), 0.0);
    }
    template <class T>
    void add_to(const SceneView<T>& scene, int64_t face, const GradientSink& to, LocalGradients& grad) const {
        const bool textured = is_textured(scene, face);
        if (textured ? to.uvs : to.colors)
            for (int i = 0; i < 3; ++i)
                (textured ? grad.uvs : grad.colors).add(scene.corners[3 * face + i], value.data() + i * width);
        if (!attributes.empty()) add_attribute_rows(scene, face, attributes.data(), to, grad);
    }
};

// Returns the cotangent of the barycentrics. Adds cotangents of corners to `corners`, and of texels to `grad`.
template <int N, class T>
Barycentrics shade_vjp(const SceneView<T>& scene, int64_t face, Barycentrics b, const double* bar, bool want_texels,
                       CornerGrad& corners, LocalGradients& grad) {
    const int C = radiance_of<N>(scene);
    const int32_t* row = scene.corners + 3 * face;
    Barycentrics b_bar;
    if (has_attributes<N>(scene)) b_bar = shade_attributes_vjp(scene, face, b, bar + C, corners.attributes.data());
    if (is_textured(scene, face)) {
        const Texture<T> texture = texture_of(scene, face);
        const Footprint f = footprint(texture, interpolated_uv(scene, face, b));
        const Vec2 uv_bar = eval_vjp<radiance_channels<N>>(texture, f, C, bar);
        if (want_texels) {
            double stack[16];
            std::vector<double> heap(C > 16 ? C : 0);
            double* row_bar = C > 16 ? heap.data() : stack;
            for (int i = 0; i < 4; ++i) {
                for (int c = 0; c < C; ++c) row_bar[c] = f.weight(i) * bar[c];
                grad.texels.add(f.texel[i], row_bar);
            }
        }
        for (int i = 0; i < 3; ++i)
            corners.value[2 * i] += b[i] * uv_bar.x, corners.value[2 * i + 1] += b[i] * uv_bar.y;
        const double* uv[3];
        for (int i = 0; i < 3; ++i) uv[i] = scene.uvs + 2 * int64_t(row[i]);
        b_bar.u += uv_bar.x * (uv[1][0] - uv[0][0]) + uv_bar.y * (uv[1][1] - uv[0][1]);
        b_bar.v += uv_bar.x * (uv[2][0] - uv[0][0]) + uv_bar.y * (uv[2][1] - uv[0][1]);
        return b_bar;
    }
    const T *c0 = scene.colors + int64_t(row[0]) * C, *c1 = scene.colors + int64_t(row[1]) * C,
            *c2 = scene.colors + int64_t(row[2]) * C;
    for (int c = 0; c < C; ++c) {
        corners.value[c] += (1 - b.u - b.v) * bar[c];
        corners.value[C + c] += b.u * bar[c];
        corners.value[2 * C + c] += b.v * bar[c];
        b_bar.u += bar[c] * (double(c1[c]) - c0[c]);
        b_bar.v += bar[c] * (double(c2[c]) - c0[c]);
    }
    return b_bar;
}

// Writes the derivative of all channels for tangents of the barycentrics and of the arrays.
template <class T>
void shade_jvp(const SceneView<T>& scene, int64_t face, Barycentrics b, Barycentrics b_dot, const Tangents& tangents,
               double* out) {
    const int C = scene.radiance;
    const int32_t* row = scene.corners + 3 * face;
    if (has_attributes<0>(scene)) shade_attributes_jvp(scene, face, b, b_dot, tangents, out + C);
    if (is_textured(scene, face)) {
        const Texture<T> texture = texture_of(scene, face);
        const Footprint f = footprint(texture, interpolated_uv(scene, face, b));
        Vec2 uv_dot;
        for (int i = 0; i < 3; ++i) {
            const double b_i_dot = i == 0 ? -b_dot.u - b_dot.v : i == 1 ? b_dot.u : b_dot.v;
            const double* uv = scene.uvs + 2 * int64_t(row[i]);
            uv_dot += b_i_dot * Vec2{uv[0], uv[1]};
            if (const double* dot = tangents.uvs) uv_dot += b[i] * Vec2{dot[2 * row[i]], dot[2 * row[i] + 1]};
        }
        for (int c = 0; c < C; ++c) {
            out[c] = eval_jvp(texture, f, C, c, uv_dot);
            if (tangents.texels)
                for (int i = 0; i < 4; ++i) out[c] += f.weight(i) * tangents.texels[f.texel[i] * C + c];
        }
        return;
    }
    const auto color = [&](const auto* array, int i, int c) { return double(array[int64_t(row[i]) * C + c]); };
    for (int c = 0; c < C; ++c) {
        const double c0 = color(scene.colors, 0, c);
        out[c] = b_dot.u * (color(scene.colors, 1, c) - c0) + b_dot.v * (color(scene.colors, 2, c) - c0);
        if (tangents.colors)
            for (int i = 0; i < 3; ++i) out[c] += b[i] * color(tangents.colors, i, c);
    }
}

}  // namespace edgegrad
