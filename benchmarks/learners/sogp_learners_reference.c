/* The textbook sparse online GP update and prediction (Csato & Opper 2002), plain C: the speed limit
 * against which bench_learners.py measures. One sample is added and one point deleted at every step.
 *
 * n = capacity + 1 slots, row-major C and Q (n x n), alpha (n x m), X (n x d); slot `free` is unused.
 * Squared exponential kernel with unit variance; w holds 1/lengthscale^2.
 */
#include <math.h>
#include <string.h>

static double kernel(const double *x, const double *z, const double *w, int d) {
    double s = 0.0;
    for (int i = 0; i < d; i++) { double u = x[i] - z[i]; s += u * u * w[i]; }
    return exp(-0.5 * s);
}

/* returns the slot that is free afterwards; work needs 4 n + m doubles */
int update(int n, int d, int m, double *X, double *C, double *Q, double *alpha, int free_slot,
           const double *x, const double *y, const double *w, double s2, double *work) {
    double *k = work, *s = work + n, *p = work + 2 * n, *c = work + 3 * n, *r = work + 4 * n;
    for (int i = 0; i < n; i++) k[i] = i == free_slot ? 0.0 : kernel(X + i * d, x, w, d);
    double v = 1.0, gamma = 1.0;
    for (int i = 0; i < n; i++) {
        double a = 0.0, b = 0.0;
        const double *Ci = C + i * n, *Qi = Q + i * n;
        for (int j = 0; j < n; j++) { a += Ci[j] * k[j]; b += Qi[j] * k[j]; }
        s[i] = a; p[i] = b;
        v += a * k[i]; gamma -= b * k[i];
    }
    if (gamma < 1e-9) gamma = 1e-9;
    double g = 1.0 / (s2 + v), ig = 1.0 / gamma;
    s[free_slot] = 1.0; p[free_slot] = -1.0;
    for (int o = 0; o < m; o++) {
        double mean = 0.0;
        for (int i = 0; i < n; i++) mean += k[i] * alpha[i * m + o];
        r[o] = (y[o] - mean) * g;
    }
    for (int i = 0; i < n; i++) {
        double *Ci = C + i * n, *Qi = Q + i * n, a = g * s[i], b = ig * p[i];
        for (int j = 0; j < n; j++) { Ci[j] -= a * s[j]; Qi[j] += b * p[j]; }
        for (int o = 0; o < m; o++) alpha[i * m + o] += s[i] * r[o];
    }
    memcpy(X + free_slot * d, x, d * sizeof(double));
    int out = 0;
    double best = INFINITY;
    for (int i = 0; i < n; i++) {
        double a = 0.0, rest = C[i * n + i] + Q[i * n + i];
        for (int o = 0; o < m; o++) a += alpha[i * m + o] * alpha[i * m + o];
        if (a / rest < best) { best = a / rest; out = i; }
    }
    double qi = 1.0 / Q[out * n + out], ri = 1.0 / (C[out * n + out] + Q[out * n + out]);
    for (int j = 0; j < n; j++) { p[j] = Q[out * n + j]; c[j] = C[out * n + j] + p[j]; }
    for (int o = 0; o < m; o++) r[o] = alpha[out * m + o] * ri;
    for (int i = 0; i < n; i++) {
        double *Ci = C + i * n, *Qi = Q + i * n, a = p[i] * qi, b = c[i] * ri;
        for (int j = 0; j < n; j++) { Ci[j] += a * p[j] - b * c[j]; Qi[j] -= a * p[j]; }
        for (int o = 0; o < m; o++) alpha[i * m + o] -= c[i] * r[o];
    }
    for (int i = 0; i < n; i++) C[i * n + out] = Q[i * n + out] = C[out * n + i] = Q[out * n + i] = 0.0;
    for (int o = 0; o < m; o++) alpha[out * m + o] = 0.0;
    return out;
}

/* mean (m), variance, d mean/dx (m x d), d variance/dx (d); work needs 2 n doubles */
double predict(int n, int d, int m, const double *X, const double *C, const double *alpha, int free_slot,
               const double *x, const double *w, double *mean, double *jacobian, double *slope, double *work) {
    double *k = work, *Ck = work + n, v = 1.0;
    memset(mean, 0, m * sizeof(double));
    memset(jacobian, 0, m * d * sizeof(double));
    memset(slope, 0, d * sizeof(double));
    for (int i = 0; i < n; i++) k[i] = i == free_slot ? 0.0 : kernel(X + i * d, x, w, d);
    for (int i = 0; i < n; i++) {
        double a = 0.0;
        for (int j = 0; j < n; j++) a += C[i * n + j] * k[j];
        Ck[i] = a; v += a * k[i];
        for (int o = 0; o < m; o++) mean[o] += alpha[i * m + o] * k[i];
        for (int l = 0; l < d; l++) {
            double u = k[i] * w[l] * (X[i * d + l] - x[l]);
            slope[l] += 2.0 * a * u;
            for (int o = 0; o < m; o++) jacobian[o * d + l] += alpha[i * m + o] * u;
        }
    }
    return v;
}
