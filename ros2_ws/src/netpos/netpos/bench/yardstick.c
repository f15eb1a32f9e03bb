/* The limit for the extended Kalman filter of netpos: the same algorithm and the same numbers in
 * plain C. State x y vx vy clock drift; per epoch a constant-velocity prediction with a two-state
 * clock, rows of azimuth or time of arrival linearised at the prediction, each fused as a scalar
 * in Joseph form. Built by yardstick.py, which defines the columns of a row.
 */
#include <math.h>

#define N 6

static void predict(double *restrict x, double (*restrict P)[N], double dt, double accel,
                    double white, double walk)
{
    static const int pairs[3][2] = {{0, 2}, {1, 3}, {4, 5}};
    for (int k = 0; k < 3; k++) {
        const int p = pairs[k][0], v = pairs[k][1];
        for (int j = 0; j < N; j++)
            P[p][j] += dt * P[v][j];
        for (int i = 0; i < N; i++)
            P[i][p] += dt * P[i][v];
        x[p] += dt * x[v];
    }
    for (int p = 0; p < 2; p++) {
        P[p][p] += accel * accel * dt * dt * dt / 3.0;
        P[p][p + 2] += accel * accel * dt * dt / 2.0;
        P[p + 2][p] += accel * accel * dt * dt / 2.0;
        P[p + 2][p + 2] += accel * accel * dt;
    }
    P[4][4] += white * white * dt + walk * walk * dt * dt * dt / 3.0;
    P[4][5] += walk * walk * dt * dt / 2.0;
    P[5][4] += walk * walk * dt * dt / 2.0;
    P[5][5] += walk * walk * dt;
    for (int i = 0; i < N; i++)
        for (int j = 0; j < i; j++)
            P[i][j] = P[j][i] = (P[i][j] + P[j][i]) / 2.0;
}

/* Innovation of one row from its mean, its Jacobian, and its variance with what linearising
 * leaves out. */
static double linearise(const double *row, const double *x, double (*P)[N], double height,
                        double *h, double *variance)
{
    const double dx = x[0] - row[ORIGIN], dy = x[1] - row[ORIGIN + 1],
                 dz = height - row[ORIGIN + 2];
    const double rho2 = dx * dx + dy * dy;
    for (int i = 0; i < N; i++)
        h[i] = 0.0;
    if (row[KIND] == TOA) {
        const double r2 = rho2 + dz * dz, r = sqrt(r2);
        const double px = P[0][0] * dx + P[0][1] * dy, py = P[0][1] * dx + P[1][1] * dy;
        const double along = (dx * px + dy * py) / r2;
        const double square = P[0][0] * P[0][0] + 2.0 * P[0][1] * P[0][1] + P[1][1] * P[1][1];
        h[0] = dx / r;
        h[1] = dy / r;
        h[4] = 1.0;
        *variance = row[VARIANCE] +
                    0.5 * (square - 2.0 * (px * px + py * py) / r2 + along * along) / r2;
        return row[VALUE] - (r + x[4]) - 0.5 * (P[0][0] + P[1][1] - along) / r;
    }
    const double *A = row + AXES;
    const double ux = A[0] * dx + A[1] * dy + A[2] * dz, uy = A[3] * dx + A[4] * dy + A[5] * dz;
    const double u2 = ux * ux + uy * uy;
    h[0] = (-uy * A[0] + ux * A[3]) / u2;
    h[1] = (-uy * A[1] + ux * A[4]) / u2;
    *variance = row[VARIANCE] + 0.5 *
        (P[0][0] * P[0][0] + 2.0 * P[0][1] * P[0][1] + P[1][1] * P[1][1]) / (rho2 * rho2);
    const double innovation = row[VALUE] - atan2(uy, ux) + M_PI;
    return innovation - 2.0 * M_PI * floor(innovation / (2.0 * M_PI)) - M_PI;
}

static void update(double *restrict x, double (*restrict P)[N], const double *rows, double height)
{
    double h[ROWS][N], innovation[ROWS], variance[ROWS], step[N] = {0.0};
    for (int i = 0; i < ROWS; i++)
        innovation[i] = linearise(rows + i * ROW_WIDTH, x, P, height, h[i], &variance[i]);
    for (int i = 0; i < ROWS; i++) {
        double Ph[N], K[N], hPh = 0.0, residual = innovation[i];
        for (int a = 0; a < N; a++) {
            Ph[a] = 0.0;
            for (int b = 0; b < N; b++)
                Ph[a] += P[a][b] * h[i][b];
            hPh += h[i][a] * Ph[a];
            residual -= h[i][a] * step[a];
        }
        const double s = hPh + variance[i];
        for (int a = 0; a < N; a++) {
            K[a] = Ph[a] / s;
            step[a] += K[a] * residual;
        }
        for (int a = 0; a < N; a++) {
            const double left = Ph[a] - K[a] * hPh - variance[i] * K[a];
            for (int b = a; b < N; b++)
                P[a][b] = P[b][a] = P[a][b] - K[a] * Ph[b] - left * K[b];
        }
    }
    for (int a = 0; a < N; a++)
        x[a] += step[a];
}

/* All epochs of rows (epochs, ROWS, ROW_WIDTH), in place on x (N) and P (N, N). */
void run(const double *rows, long epochs, double dt, double accel, double white, double walk,
         double height, double *x, double *P)
{
    for (long k = 0; k < epochs; k++) {
        predict(x, (double (*)[N])P, dt, accel, white, walk);
        update(x, (double (*)[N])P, rows + k * ROWS * ROW_WIDTH, height);
    }
}
