/* Dense blocks, and the chain rule. */
#define INLINE static inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 16")
#define PADDED(n) (((n) + 3)/4*4)

typedef double V __attribute__((vector_size(32), aligned(8), may_alias));

/* y += a x, of n numbers rounded up to whole vectors. */
INLINE void add(int n, double a, const double *x, double *y) {
  UNROLL for (int i = 0; i < PADDED(n)/4; i++) ((V *)y)[i] += a*((const V *)x)[i];
}

/* y = x. Vector by vector: what has just been stored in vectors is soon to be had in the same ones only. */
INLINE void copy(int n, const double *x, double *y) {
  UNROLL for (int i = 0; i < PADDED(n)/4; i++) ((V *)y)[i] = ((const V *)x)[i];
}

/* Solves A X = B in place, n rows, A symmetric, m columns of B. Returns whether A is singular. */
INLINE int solve(int n, int m, double *A, int lda, double *B, int ldb, double *scale, int *order, double *X) {
  /* Equilibration of a symmetric matrix (Bunch, J. ACM 18, 1971), whatever the units of its rows. */
  for (int i = 0; i < n; i++) {
    double largest = sqrt(fabs(A[i*lda+i]));
    for (int j = 0; j < i; j++) largest = fmax(largest, scale[j]*fabs(A[i*lda+j]));
    if (isinf(largest)) return 1;
    scale[i] = largest > 0 ? 1/largest : 0; order[i] = i; }
  for (int i = 0; i < n; i++) if (scale[i] == 0) { /* coupled with later rows alone */
    double largest = 0;
    for (int j = i + 1; j < n; j++) largest = fmax(largest, scale[j]*fabs(A[i*lda+j]));
    if (!(largest > 0)) return 1;
    scale[i] = 1/largest; }
  for (int i = 0; i < n; i++) {
    for (int j = 0; j < n; j++) A[i*lda+j] *= scale[i]*scale[j];
    for (int j = 0; j < m; j++) B[i*ldb+j] *= scale[i]; }
  for (int k = 0; k < n; k++) {
    int p = k;
    for (int i = k + 1; i < n; i++) if (fabs(A[order[i]*lda+k]) > fabs(A[order[p]*lda+k])) p = i;
    int row = order[p]; order[p] = order[k]; order[k] = row;
    double *a = A + row*lda, *b = B + row*ldb;
    if (!(fabs(a[k]) > 1e-14)) return 1;
    double inverse = 1/a[k];
    for (int i = k + 1; i < n; i++) {
      double *c = A + order[i]*lda, *d = B + order[i]*ldb, f = c[k]*inverse;
      if (f == 0) continue;
      for (int j = k + 1; j < n; j++) c[j] -= f*a[j];
      for (int j = 0; j < m; j++) d[j] -= f*b[j]; } }
  for (int k = n - 1; k >= 0; k--) {
    const double *a = A + order[k]*lda, *b = B + order[k]*ldb;
    double inverse = 1/a[k];
    for (int j = 0; j < m; j++) X[k*m+j] = b[j];
    for (int i = k + 1; i < n; i++) for (int j = 0; j < m; j++) X[k*m+j] -= a[i]*X[i*m+j];
    for (int j = 0; j < m; j++) X[k*m+j] *= inverse; }
  for (int k = 0; k < n; k++) for (int j = 0; j < m; j++) B[k*ldb+j] = scale[k]*X[k*m+j];
  return 0;
}

/* Makes a symmetric matrix positive semi-definite: negative eigenvalues to 0, or to their absolute value. */
static void project(int n, double *A, int lda, int absolute) {
  double M[n][n], V[n][n], largest = 0;
  int definite = 1;
  for (int i = 0; i < n; i++) {
    largest = fmax(largest, fabs(A[i*lda+i]));
    for (int j = 0; j < n; j++) { M[i][j] = 0.5*(A[i*lda+j] + A[j*lda+i]); V[i][j] = M[i][j]; } }
  for (int k = 0; k < n && definite; k++) { /* Cholesky's factorisation exists */
    definite = V[k][k] > 1e-14*largest;
    for (int i = k + 1; i < n; i++) for (int j = k + 1; j <= i; j++) V[i][j] -= V[i][k]*V[j][k]/V[k][k]; }
  if (definite) return;
  for (int i = 0; i < n; i++) for (int j = 0; j < n; j++) V[i][j] = i == j;
  for (int sweep = 0; sweep < 30; sweep++) { /* Jacobi; the rows of V become eigenvectors */
    double off = 0;
    for (int p = 0; p < n; p++) for (int q = p + 1; q < n; q++) off = fmax(off, fabs(M[p][q]));
    if (!(off > 1e-15*largest)) break;
    for (int p = 0; p < n; p++) for (int q = p + 1; q < n; q++) {
      if (fabs(M[p][q]) <= 1e-16*largest) continue;
      double z = (M[q][q] - M[p][p])/(2*M[p][q]), t = copysign(1, z)/(fabs(z) + sqrt(1 + z*z));
      double c = 1/sqrt(1 + t*t), s = c*t;
      for (int i = 0; i < n; i++) { double x = M[p][i], y = M[q][i]; M[p][i] = c*x - s*y; M[q][i] = s*x + c*y; }
      for (int i = 0; i < n; i++) { double x = M[i][p], y = M[i][q]; M[i][p] = c*x - s*y; M[i][q] = s*x + c*y; }
      for (int i = 0; i < n; i++) { double x = V[p][i], y = V[q][i]; V[p][i] = c*x - s*y; V[q][i] = s*x + c*y; } } }
  for (int k = 0; k < n; k++) if (M[k][k] < 0) {
    double rise = -M[k][k]*(absolute ? 2 : 1);
    for (int i = 0; i < n; i++) for (int j = 0; j < n; j++) A[i*lda+j] += rise*V[k][i]*V[k][j]; }
}

/* ---- chain rule for a function r(a(y)): dr = G L da; n : d^2 r = (L da).C (L da) + 2 (E da).(L da) ---- */

/* Adds to the Hessian H by y before r what there is by r. a's derivative is J, or 1 at first .. first + na - 1
   if J is 0; r is a itself if G is 0. `rows` tells which of y are coupled with r. */
INLINE void chain(double *H, const unsigned char *rows, int r, int nr, int rank, int first, int na,
                  const double *J, const double *G, const double *L, const double *C, const double *E) {
  enum { M = PADDED(RANK), N = PADDED(NY) };
  int q0 = J ? 0 : first, nq = J ? r : na;
  double O[RANK][N], S[RANK][N], T[NY][M], g[NY][M], K[RANK][RANK];
  for (int k = 0; k < rank; k++) {
    for (int q = 0; q < PADDED(nq); q++) O[k][q] = S[k][q] = 0;
    for (int a = 0; a < na; a++) {
      if (G && J) { add(nq, L[k*na+a], J + a*NY, O[k]); add(nq, E[k*na+a], J + a*NY, S[k]); }
      else if (G) { O[k][a] = L[k*na+a]; S[k][a] = E[k*na+a]; } }
    if (!G) for (int q = 0; q < nq; q++) O[k][q] = J[k*NY+q];
    for (int l = 0; l < rank; l++) K[k][l] = G ? C[k*rank+l] : H[(r+k)*NY+r+l]; }
  if (G) for (int i = 0; i < nr; i++) for (int k = 0; k < M; k++) g[i][k] = k < rank ? G[i*rank+k] : 0;
  if (G && rows[r]) for (int i = 0; i < nr; i++) {
    double h[M] = {0};
    for (int j = 0; j < nr; j++) add(rank, H[(r+i)*NY+r+j], g[j], h);
    for (int k = 0; k < rank; k++) for (int l = 0; l < rank; l++) K[k][l] += g[i][k]*h[l]; }
  for (int k = 0; k < rank; k++) for (int l = 0; l < rank; l++) add(nq, 0.5*K[k][l], O[l], S[k]);
  for (int p = 0; p < r; p++) {
    for (int k = 0; k < M; k++) T[p][k] = 0;
    if (rows[p]) {
      if (G) for (int i = 0; i < nr; i++) add(rank, H[p*NY+r+i], g[i], T[p]);
      else for (int k = 0; k < rank; k++) T[p][k] = H[p*NY+r+k]; }
    if (p >= q0 && p < q0 + nq) for (int k = 0; k < rank; k++) S[k][p-q0] = T[p][k] += S[k][p-q0]; }
  for (int p = 0; p < r; p++) {
    int within = p >= q0 && p < q0 + nq;
    if (!rows[p] && !within) continue;
    double h[N];
    for (int q = 0; q < PADDED(nq); q++) h[q] = 0;
    for (int k = 0; k < rank; k++) add(nq, T[p][k], O[k], h);
    if (within) for (int k = 0; k < rank; k++) add(nq, O[k][p-q0], S[k], h);
    add(nq, 1, h, H + p*NY + q0);
    /* Of the local unknowns' coupling with arguments one half is read only. */
    if (!within && (p < NA || p >= NZ || q0 >= NA)) for (int q = 0; q < nq; q++) H[(q0+q)*NY+p] += h[q]; }
}

/* Adds to the gradient g by y before r what there is by r. */
INLINE void pull_back(double *g, int r, int nr, int rank, int first, int na, const double *J, const double *G,
                      const double *L, double *m) {
  for (int a = 0; a < na; a++) m[a] = G ? 0 : g[r+a];
  if (G) for (int k = 0; k < rank; k++) {
    double w = 0;
    for (int i = 0; i < nr; i++) w += G[i*rank+k]*g[r+i];
    for (int a = 0; a < na; a++) m[a] += w*L[k*na+a]; }
  for (int a = 0; a < na; a++) {
    if (!J) g[first+a] += m[a];
    else for (int q = 0; q < r; q++) g[q] += m[a]*J[a*NY+q]; }
}

/* Makes it the multiple of the identity by its largest diagonal entry. */
INLINE void spread(int n, double *A, int lda) {
  double largest = 0;
  for (int i = 0; i < n; i++) largest = fmax(largest, A[i*lda+i]);
  for (int i = 0; i < n; i++) for (int j = 0; j < n; j++) A[i*lda+j] = i == j ? largest : 0;
}
