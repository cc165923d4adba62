#include "estimator/pixel_samples.h"

namespace edgegrad {

EDGEGRAD_VECTORIZED void place_in_pixel(const Camera& camera, const Filter& filter, int x, int y, int n, double* n_x,
                                        double* n_y) {
    filter.sample(n, n_x), filter.sample(n, n_y);
    // This is normalised() with shared values in locals, because the compiler cannot know that the arrays do not alias.
    const Vec2 n0 = normalised(camera, {x + 0.5, y + 0.5});
    const double a = camera.k_inverse[0], b = camera.k_inverse[1], c = camera.k_inverse[2], d = camera.k_inverse[3];
    for (int i = 0; i < n; ++i) {
        const double dx = n_x[i], dy = n_y[i];
        n_x[i] = n0.x + (a * dx + b * dy), n_y[i] = n0.y + (c * dx + d * dy);
    }
    if (!camera.is_undistorted()) undistort_near(camera.lens, camera.lens_view.disc, n0, n, n_x, n_y);
}

EDGEGRAD_VECTORIZED void PixelRays::append(int x, int y, int first, int n, CameraRays& rays) const {
    double *n_x = rays.n_x + rays.count, *n_y = rays.n_y + rays.count;
    lattice_.fill(hash(seed_, uint64_t(y) * camera_.width + x), first, n, n_x, n_y);
    place_in_pixel(camera_, filter_, x, y, n, n_x, n_y);
    rays.count += n;
}

}  // namespace edgegrad
