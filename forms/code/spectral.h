/* Functions of symmetric tensors, r = f(A), by eigenvalues; see forms/spectral.py.

   Of a tensor the lower triangle counts, row by row. parameters: number of the function, exponent.
   Kept: eigenvectors V (by columns), eigenvalues, f[a, b] of pairs of these, f[a, b, c] of triples. With
   D = V^T dA V, (V^T dr V)_ij = f[i, j] D_ij + sum_k f[i, k, j] D_ik D_kj + ... (Daletskii and Krein). */
#define SPECTRAL_N (DIM*(DIM + 1)/2)

enum { LOGARITHM, EXPONENTIAL, POWER };

static void eigenvalues(const double *lower, double *values, double *V) {
  double A[DIM][DIM];
  for (int i = 0, n = 0; i < DIM; i++) for (int j = 0; j <= i; j++, n++) A[i][j] = A[j][i] = lower[n];
  for (int i = 0; i < DIM*DIM; i++) V[i] = i % (DIM + 1) == 0;
  for (int sweep = 0; sweep < 30; sweep++) {
    int turned = 0;
    for (int p = 0; p < DIM - 1; p++) for (int q = p + 1; q < DIM; q++) {
      if (!(fabs(A[p][q]) > 1e-17*(fabs(A[p][p]) + fabs(A[q][q])))) continue;
      double z = (A[q][q] - A[p][p])/(2*A[p][q]), t = copysign(1, z)/(fabs(z) + sqrt(1 + z*z));
      double c = 1/sqrt(1 + t*t), s = c*t;
      for (int i = 0; i < DIM; i++) { double x = A[i][p], y = A[i][q]; A[i][p] = c*x - s*y; A[i][q] = s*x + c*y; }
      for (int i = 0; i < DIM; i++) { double x = A[p][i], y = A[q][i]; A[p][i] = c*x - s*y; A[q][i] = s*x + c*y; }
      for (int i = 0; i < DIM; i++) {
        double x = V[DIM*i+p], y = V[DIM*i+q]; V[DIM*i+p] = c*x - s*y; V[DIM*i+q] = s*x + c*y; }
      turned = 1; }
    if (!turned) break; }
  for (int i = 0; i < DIM; i++) values[i] = A[i][i];
}

static inline double function_of(const double *parameters, double x) {
  switch ((int)parameters[0]) {
    case LOGARITHM: return log(x);
    case EXPONENTIAL: return exp(x);
    default: return pow(x, parameters[1]); }
}

/* f' at x, of which f is known. */
static inline double slope_of(const double *parameters, double x, double f) {
  switch ((int)parameters[0]) {
    case LOGARITHM: return 1/x;
    case EXPONENTIAL: return f;
    default: return parameters[1]*f/x; }
}

typedef struct { double x[DIM], f[DIM], slope[DIM][DIM]; } Spectrum; /* slope: f' in the middle of two */

static inline int are_close(const double *parameters, double low, double high) {
  return high - low <= 0.25*((int)parameters[0] == EXPONENTIAL ? 1 : fabs(0.5*(low + high)));
}

/* f[x[at[0]], ..., x[at[n-1]]] for n = 2 or 3, by a power series around the middle where they are close:
   sum over k of t_k h_{k-n+1}(x - middle), t_k = f^(k)/k! there, h the complete homogeneous polynomials. */
static double divided_difference(const double *parameters, const Spectrum *s, const int *at, int n) {
  int a = 0, c = 0;
  for (int i = 1; i < n; i++) {
    if (s->x[at[i]] < s->x[at[a]]) a = i;
    if (s->x[at[i]] > s->x[at[c]]) c = i; }
  double low = s->x[at[a]], high = s->x[at[c]], m = 0.5*(low + high);
  if (!are_close(parameters, low, high)) {
    if (n == 2) return (s->f[at[c]] - s->f[at[a]])/(high - low);
    int lower[2] = {at[a], at[3-a-c]}, upper[2] = {at[3-a-c], at[c]};
    return (divided_difference(parameters, s, upper, 2) - divided_difference(parameters, s, lower, 2))/(high - low); }
  int kind = (int)parameters[0];
  double alpha = kind == POWER ? parameters[1] : 0, t = s->slope[at[a]][at[c]], h[3] = {1, 1, 1}, sum = 0, reach = 1;
  if (n == 3) t *= kind == EXPONENTIAL ? 0.5 : (alpha - 1)/(2*m);
  for (int k = n - 1; k < n + 20; k++) {
    sum += t*h[n-1];
    reach *= 0.5*(high - low);
    if (fabs(t)*reach <= 1e-18*fabs(sum)) break;
    h[0] *= s->x[at[0]] - m; /* h_j+1 of some arguments, from that of one less and h_j of these */
    for (int i = 1; i < n; i++) h[i] = h[i-1] + (s->x[at[i]] - m)*h[i];
    t *= kind == EXPONENTIAL ? 1.0/(k + 1) : (alpha - k)/((k + 1)*m); }
  return sum;
}

/* like: what another function has kept of the same A, or 0. */
static void decompose(const double *A, double *V, double *x, const double *like) {
  if (!like) eigenvalues(A, x, V);
  else { memcpy(V, like, DIM*DIM*sizeof(double)); memcpy(x, like + DIM*DIM, DIM*sizeof(double)); }
}

/* The lower triangle of D = L dA. */
static void turn(const double *V, double *L) {
  for (int i = 0, n = 0; i < DIM; i++) for (int j = 0; j <= i; j++, n++)
    for (int a = 0, m = 0; a < DIM; a++) for (int b = 0; b <= a; b++, m++) {
      double ab = V[DIM*i+a]*V[DIM*j+b], ba = V[DIM*i+b]*V[DIM*j+a];
      L[m*SPECTRAL_N+n] = i == j ? ab : ab + ba; }
}

static void spectral_value(const double *parameters, const double *A, double *r, double *kept, const double *like) {
  double *V = kept, *x = V + DIM*DIM, *f1 = x + DIM, *f2 = f1 + DIM*DIM;
  Spectrum s;
  decompose(A, V, x, like);
  memcpy(s.x, x, sizeof s.x);
  for (int i = 0; i < DIM; i++) s.f[i] = function_of(parameters, s.x[i]);
  for (int i = 0; i < DIM; i++) for (int j = 0; j <= i; j++) {
    double m = 0.5*(s.x[i] + s.x[j]), low = fmin(s.x[i], s.x[j]), high = fmax(s.x[i], s.x[j]);
    s.slope[i][j] = s.slope[j][i] = !are_close(parameters, low, high) ? 0
      : slope_of(parameters, m, i == j ? s.f[i] : function_of(parameters, m)); }
  for (int i = 0; i < DIM; i++) for (int j = i; j < DIM; j++) {
    f1[DIM*i+j] = f1[DIM*j+i] = divided_difference(parameters, &s, (int[]){i, j}, 2);
    for (int k = j; k < DIM; k++) {
      double d = divided_difference(parameters, &s, (int[]){i, j, k}, 3);
      f2[(i*DIM+j)*DIM+k] = f2[(i*DIM+k)*DIM+j] = f2[(j*DIM+i)*DIM+k] = d;
      f2[(j*DIM+k)*DIM+i] = f2[(k*DIM+i)*DIM+j] = f2[(k*DIM+j)*DIM+i] = d; } }
  for (int i = 0, n = 0; i < DIM; i++) for (int j = 0; j <= i; j++, n++) {
    r[n] = 0;
    for (int k = 0; k < DIM; k++) r[n] += V[DIM*i+k]*s.f[k]*V[DIM*j+k]; }
}

static void spectral_first(const double *parameters, const double *r, const double *kept, double *G, double *L) {
  const double *V = kept, *f1 = V + DIM*DIM + DIM;
  turn(V, L);
  for (int i = 0, n = 0; i < DIM; i++) for (int j = 0; j <= i; j++, n++)
    for (int a = 0, m = 0; a < DIM; a++) for (int b = 0; b <= a; b++, m++) /* entries off a diagonal stand for two */
      G[n*SPECTRAL_N+m] = f1[DIM*a+b]*L[m*SPECTRAL_N+n]*(a == b ? 1 : 2)/(i == j ? 1 : 2);
}

static void spectral_second(const double *parameters, const double *r, const double *kept, const double *n, double *C,
                            double *E) {
  const double *V = kept, *f2 = V + 2*DIM*DIM + DIM;
  double N[DIM][DIM];
  for (int a = 0; a < DIM; a++) for (int b = 0; b < DIM; b++) {
    N[a][b] = 0;
    for (int i = 0, k = 0; i < DIM; i++) for (int j = 0; j <= i; j++, k++)
      N[a][b] += i == j ? n[k]*V[DIM*i+a]*V[DIM*i+b]
                        : 0.5*n[k]*(V[DIM*i+a]*V[DIM*j+b] + V[DIM*j+a]*V[DIM*i+b]); }
  for (int i = 0; i < SPECTRAL_N*SPECTRAL_N; i++) C[i] = E[i] = 0;
  for (int i = 0; i < DIM; i++) for (int j = 0; j < DIM; j++) for (int k = 0; k < DIM; k++) {
    int p = i > k ? i*(i+1)/2 + k : k*(k+1)/2 + i, q = k > j ? k*(k+1)/2 + j : j*(j+1)/2 + k;
    double c = N[i][j]*f2[(i*DIM+k)*DIM+j];
    C[p*SPECTRAL_N+q] += c; C[q*SPECTRAL_N+p] += c; }
}

/* Traces of powers, r_e = tr A^a_e. parameters: how many, the exponents. Kept: V, eigenvalues x, and of each power
   f = x^a f'(x_i), f'[x_i, x_j] of pairs. To second order r is sum_i f'(x_i) D_ii + sum_ij f'[x_i, x_j] D_ij^2 / 2. */
#define TRACES_KEPT (DIM + SPECTRAL_N)

static void traces_value(const double *parameters, const double *A, double *r, double *kept, const double *like) {
  double *V = kept, *x = V + DIM*DIM, *f1 = x + DIM, gap[SPECTRAL_N], log_ratio[SPECTRAL_N];
  decompose(A, V, x, like);
  for (int i = 0, m = 0; i < DIM; i++) for (int j = 0; j <= i; j++, m++) {
    gap[m] = (x[i] - x[j])/x[j];
    log_ratio[m] = i == j ? 0 : log1p(gap[m]); }
  for (int e = 0; e < (int)parameters[0]; e++, f1 += TRACES_KEPT) {
    double a = parameters[1+e], f[DIM];
    r[e] = 0;
    for (int i = 0; i < DIM; i++) { f[i] = pow(x[i], a); r[e] += f[i]; f1[i] = a*f[i]/x[i]; }
    for (int i = 0, m = 0; i < DIM; i++) for (int j = 0; j <= i; j++, m++) /* exact for close ones too */
      f1[DIM+m] = f1[j]/x[j]*(gap[m] == 0 ? a - 1 : expm1((a - 1)*log_ratio[m])/gap[m]); }
}

static void traces_first(const double *parameters, const double *r, const double *kept, double *G, double *L) {
  const double *f1 = kept + DIM*DIM + DIM;
  turn(kept, L);
  for (int e = 0; e < (int)parameters[0]; e++, f1 += TRACES_KEPT)
    for (int a = 0, m = 0; a < DIM; a++) for (int b = 0; b <= a; b++, m++) G[e*SPECTRAL_N+m] = a == b ? f1[a] : 0;
}

static void traces_second(const double *parameters, const double *r, const double *kept, const double *n, double *C,
                          double *E) {
  const double *f1 = kept + DIM*DIM + DIM;
  for (int i = 0; i < SPECTRAL_N*SPECTRAL_N; i++) C[i] = E[i] = 0;
  for (int e = 0; e < (int)parameters[0]; e++, f1 += TRACES_KEPT)
    for (int a = 0, m = 0; a < DIM; a++) for (int b = 0; b <= a; b++, m++)
      C[m*SPECTRAL_N+m] += n[e]*f1[DIM+m]*(a == b ? 1 : 2);
}
