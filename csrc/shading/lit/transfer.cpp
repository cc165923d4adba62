#include "shading/lit/transfer.h"

#include <algorithm>
#include <vector>

#include "shading/lit/path_radiance.h"

namespace edgegrad {

template <class T>
void send_between(const LitScene& lit, const SceneView<T>& scene, const RayCaster& caster, const LitLines& lines,
                  SentRadiance wanted, Paths& paths, double* out) {
    const int C = lit.channels;
    std::fill(out, out + lines.size * C, 0.0);
    std::vector<Surface<double>> receivers(lines.size);
    const auto place = [&](int64_t i, Surface<double>& reflector) {
        Surface<double>& receiver = receivers[i];
        set_place<double>(lit, lines.receiver[i], lines.receiver_b + 3 * i, nullptr, receiver);
        set_place<double>(lit, lines.reflector[i], lines.reflector_b + 3 * i, nullptr, reflector);
        const Vec3 l = unit(reflector.y - receiver.y);
        set_view<double>(lit, wanted == SentRadiance::seen_by_viewer ? towards_viewer<double>(lit, receiver.y) : l,
                         receiver);
        set_view<double>(lit, -l, reflector);
        return Paths::scatters(receiver) && dot(receiver.n, l) > 0 && dot(receiver.g, l) > 0;
    };
    paths.find_with_light_samples(scene, caster,
                                  {lines.size, lines.reflector, lines.reflector_b, lines.seed, {}, nullptr}, place);
    double sent[most_lit_channels], f[most_lit_channels];
    for (int64_t i = 0; i < lines.size; ++i) {
        const Path path = paths.path(i);
        if (path.points == 0) continue;
        const auto at = [&](int k) -> const Surface<double>& { return paths.surface(i, k); };
        path_radiance(lit, paths.lights(), path, at, sent);
        add_direct(lit, paths.lights(), path, 0, at(0), sent);
        if (wanted == SentRadiance::at_receiver) {
            std::copy(sent, sent + C, out + i * C);
            continue;
        }
        Surface<double>& o = receivers[i];
        look_up_material(lit, o);
        const Vec3 l = -at(0).v;
        scatter(o.scattering, o.v, o.n, l, C, f);
        const double terminated = o.mesh->normal.is_flat() ? 1 : terminator<double>(o.g, o.n, l);
        const double factor = terminated * dot(o.n, l) / dot(o.g, l);
        for (int c = 0; c < C; ++c) out[i * C + c] = f[c] * factor * sent[c];
    }
}

template void send_between(const LitScene&, const SceneView<float>&, const RayCaster&, const LitLines&, SentRadiance,
                           Paths&, double*);
template void send_between(const LitScene&, const SceneView<double>&, const RayCaster&, const LitLines&, SentRadiance,
                           Paths&, double*);

}  // namespace edgegrad
