/* The discrete Moser-Veselov map by hand: divided equation in the Rodrigues vector, third-order
   guess, a fixed number of Newton iterations, every attitude and momentum stored. */

void tumble(long steps, int newton, const double *R0, const double *pi0, const double *J,
            const double *dt, long dt_stride, const double *torques, double *R, double *pi) {
  const double t = J[0] + J[4] + J[8];
  const double a = J[0] / t, b = J[4] / t, c = J[8] / t;
  const double d = J[1] / t, e = J[2] / t, f = J[5] / t;
  double ia = b * c - f * f, id = e * f - d * c, ie = d * f - e * b;
  double ib = a * c - e * e, jf = d * e - a * f, ic = a * b - d * d;
  const double det = a * ia + d * id + e * ie;
  ia /= det, id /= det, ie /= det, ib /= det, jf /= det, ic /= det;
  for (int i = 0; i < 9; i++) R[i] = R0[i];
  for (int i = 0; i < 3; i++) pi[i] = pi0[i];
  for (long k = 0; k < steps; k++, R += 9, pi += 3) {
    const double h = dt[k * dt_stride];
    double u = pi[0], v = pi[1], w = pi[2];
    if (torques) {
      u += h / 2 * torques[3 * k], v += h / 2 * torques[3 * k + 1];
      w += h / 2 * torques[3 * k + 2];
    }
    const double p = u * h / t, q = v * h / t, r = w * h / t;
#define OVER_2J(x, y, z, ox, oy, oz)                                  \
  const double ox = (ia * (x) + id * (y) + ie * (z)) / 2,             \
               oy = (id * (x) + ib * (y) + jf * (z)) / 2,             \
               oz = (ie * (x) + jf * (y) + ic * (z)) / 2;
    OVER_2J(p, q, r, x1, y1, z1)
    OVER_2J(z1 * q - y1 * r, x1 * r - z1 * p, y1 * p - x1 * q, x2, y2, z2)
    const double s = x1 * p + y1 * q + z1 * r;
    OVER_2J(z2 * q - y2 * r + x1 * s, x2 * r - z2 * p + y1 * s, y2 * p - x2 * q + z1 * s, x3, y3, z3)
    double x = x1 + x2 + x3, y = y1 + y2 + y3, z = z1 + z2 + z3;
    for (int n = 0; n < newton; n++) {
      const double m = x * p + y * q + z * r;
      const double r0 = a * x + d * y + e * z - (p - y * r + z * q + x * m) / 2;
      const double r1 = d * x + b * y + f * z - (q - z * p + x * r + y * m) / 2;
      const double r2 = e * x + f * y + c * z - (r - x * q + y * p + z * m) / 2;
      const double A = a - (m + x * p) / 2, B = d + (r - x * q) / 2, C = e - (q + x * r) / 2;
      const double D = d - (r + y * p) / 2, E = b - (m + y * q) / 2, F = f + (p - y * r) / 2;
      const double G = e + (q - z * p) / 2, H = f - (p + z * q) / 2, I = c - (m + z * r) / 2;
      const double k0 = E * I - F * H, k1 = F * G - D * I, k2 = D * H - E * G;
      const double over = 1 / (A * k0 + B * k1 + C * k2);
      x -= (k0 * r0 + (C * H - B * I) * r1 + (B * F - C * E) * r2) * over;
      y -= (k1 * r0 + (A * I - C * G) * r1 + (C * D - A * F) * r2) * over;
      z -= (k2 * r0 + (B * G - A * H) * r1 + (A * E - B * D) * r2) * over;
    }
    const double g = 2 / (1 + x * x + y * y + z * z);
    const double T[9] = {1 - g * (y * y + z * z), g * (x * y - z), g * (x * z + y),
                         g * (x * y + z), 1 - g * (x * x + z * z), g * (y * z - x),
                         g * (x * z - y), g * (y * z + x), 1 - g * (x * x + y * y)};
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++)
        R[9 + 3 * i + j] = R[3 * i] * T[j] + R[3 * i + 1] * T[3 + j] + R[3 * i + 2] * T[6 + j];
    for (int j = 0; j < 3; j++) {
      pi[3 + j] = T[j] * u + T[3 + j] * v + T[6 + j] * w;
      if (torques) pi[3 + j] += h / 2 * torques[3 * k + 3 + j];
    }
  }
}
