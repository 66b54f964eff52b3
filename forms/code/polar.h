/* The polar rotation r = R(F) in SO(3), F = R S, see forms/rotation.py.

   Kept: T = (tr S I - S)^-1, its lower triangle. A change of F turns R by the spin w = T axial(A - A^T),
   A = R^T dF: dR = R [w]x. To second order R^T R(F + dF) = I + [w]x + [w]x^2 / 2 - [T (tr D I - D) w]x with
   D = sym A. Where two singular values cancel R has no derivative; their sum counts as no less than
   POLAR_GAP times the largest, or than POLAR_GAP if that is below 1. */
#define POLAR_GAP 1e-8

static inline void cofactor(const double *F, double *K) {
  K[0] = F[4]*F[8] - F[5]*F[7]; K[1] = F[5]*F[6] - F[3]*F[8]; K[2] = F[3]*F[7] - F[4]*F[6];
  K[3] = F[2]*F[7] - F[1]*F[8]; K[4] = F[0]*F[8] - F[2]*F[6]; K[5] = F[1]*F[6] - F[0]*F[7];
  K[6] = F[1]*F[5] - F[2]*F[4]; K[7] = F[2]*F[3] - F[0]*F[5]; K[8] = F[0]*F[4] - F[1]*F[3];
}

/* One-sided Jacobi: F = U diag(s) V^T with rotations U and V, s[0] >= s[1] >= |s[2]|. */
static void singular_values(const double *F, double *U, double *s, double *V) {
  double B[9], norms[3];
  for (int i = 0; i < 9; i++) { B[i] = F[i]; V[i] = i % 4 == 0; }
  for (int sweep = 0; sweep < 30; sweep++) {
    int turned = 0;
    for (int p = 0; p < 2; p++) for (int q = p + 1; q < 3; q++) {
      double a = 0, b = 0, g = 0;
      for (int i = 0; i < 9; i += 3) { a += B[i+p]*B[i+p]; b += B[i+q]*B[i+q]; g += B[i+p]*B[i+q]; }
      if (!(fabs(g) > 1e-16*sqrt(a)*sqrt(b))) continue;
      double z = (b - a)/(2*g), t = copysign(1, z)/(fabs(z) + sqrt(1 + z*z));
      double c = 1/sqrt(1 + t*t), d = c*t;
      for (int i = 0; i < 9; i += 3) {
        double x = B[i+p], y = B[i+q]; B[i+p] = c*x - d*y; B[i+q] = d*x + c*y;
        x = V[i+p], y = V[i+q]; V[i+p] = c*x - d*y; V[i+q] = d*x + c*y; }
      turned = 1; }
    if (!turned) break; }
  for (int p = 0; p < 3; p++) norms[p] = B[p]*B[p] + B[p+3]*B[p+3] + B[p+6]*B[p+6];
  for (int pass = 0; pass < 3; pass++) { /* sort columns; a swap changes a sign and stays a rotation */
    int p = pass % 2, q = p + 1;
    if (norms[p] >= norms[q]) continue;
    double t = norms[p]; norms[p] = norms[q]; norms[q] = t;
    for (int i = 0; i < 9; i += 3) {
      t = B[i+p]; B[i+p] = B[i+q]; B[i+q] = -t; t = V[i+p]; V[i+p] = V[i+q]; V[i+q] = -t; } }
  double u[3] = {1, 0, 0}, v[3] = {0, 0, 0};
  s[0] = sqrt(norms[0]);
  if (s[0] > 0) for (int i = 0; i < 3; i++) u[i] = B[3*i]/s[0];
  double dot = u[0]*B[1] + u[1]*B[4] + u[2]*B[7], rest = 0;
  for (int i = 0; i < 3; i++) { v[i] = B[3*i+1] - dot*u[i]; rest += v[i]*v[i]; }
  s[1] = sqrt(rest);
  if (!(s[1] > 1e-15*s[0])) { /* F maps to a line: any direction beside it */
    int k = fabs(u[0]) <= fabs(u[1]) ? (fabs(u[0]) <= fabs(u[2]) ? 0 : 2) : (fabs(u[1]) <= fabs(u[2]) ? 1 : 2);
    rest = 0;
    for (int i = 0; i < 3; i++) { v[i] = (i == k) - u[k]*u[i]; rest += v[i]*v[i]; } }
  rest = 1/sqrt(rest);
  for (int i = 0; i < 3; i++) { v[i] *= rest; U[3*i] = u[i]; U[3*i+1] = v[i]; }
  U[2] = u[1]*v[2] - u[2]*v[1]; U[5] = u[2]*v[0] - u[0]*v[2]; U[8] = u[0]*v[1] - u[1]*v[0];
  s[2] = U[2]*B[2] + U[5]*B[5] + U[8]*B[8];
}

static void polar_by_singular_values(const double *F, double *R, double *T) {
  double U[9], s[3], V[9], g[3];
  singular_values(F, U, s, V);
  double least = POLAR_GAP*fmax(1, s[0]);
  for (int k = 0; k < 3; k++) g[k] = 1/fmax(s[(k+1) % 3] + s[(k+2) % 3], least);
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
    R[3*i+j] = 0;
    for (int k = 0; k < 3; k++) R[3*i+j] += U[3*i+k]*V[3*j+k]; }
  for (int i = 0, n = 0; i < 3; i++) for (int j = 0; j <= i; j++, n++) {
    T[n] = 0;
    for (int k = 0; k < 3; k++) T[n] += V[3*i+k]*g[k]*V[3*j+k]; }
}

/* R from f = tr S, the largest root of f^4 - 2 I1 f^2 - 8 J f + 2 tr C^2 - I1^2, C = F^T F, I1 = tr C,
   J = det F; then R = (f^2 F + 2 f cof F - 2 F C + I1 F)/(f^3 - I1 f - 2 J). The denominator is
   2 (s0 + s1)(s1 + s2)(s2 + s0) of the singular values. Rounding errors grow with the square of f^3 by it;
   where they would exceed some 1e-13, by singular values. */
static void polar_value(const double *parameters, const double *F, double *R, double *T, const double *like) {
  double K[9], C[9], S[6], I1 = 0, t2 = 0;
  cofactor(F, K);
  double J = F[0]*K[0] + F[1]*K[1] + F[2]*K[2];
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++)
    C[3*i+j] = F[i]*F[j] + F[3+i]*F[3+j] + F[6+i]*F[6+j];
  I1 = C[0] + C[4] + C[8];
  for (int i = 0; i < 9; i++) t2 += C[i]*C[i];
  double f = sqrt(3*I1), c0 = 2*t2 - I1*I1, step = f;
  for (int k = 0; k < 20 && fabs(step) > 1e-13*f; k++) {
    double p = ((f*f - 2*I1)*f - 8*J)*f + c0;
    step = p/(4*((f*f - I1)*f - 2*J));
    f -= step; }
  double denominator = (f*f - I1)*f - 2*J;
  if (!(denominator > 5e-2*f*f*f)) { polar_by_singular_values(F, R, T); return; }
  double scale = 1/denominator, a = f*f + I1;
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
    double FC = F[3*i]*C[j] + F[3*i+1]*C[3+j] + F[3*i+2]*C[6+j];
    R[3*i+j] = (a*F[3*i+j] + 2*f*K[3*i+j] - 2*FC)*scale; }
  for (int i = 0, n = 0; i < 3; i++) for (int j = 0; j <= i; j++, n++)
    S[n] = 0.5*(R[i]*F[j] + R[3+i]*F[3+j] + R[6+i]*F[6+j] + R[j]*F[i] + R[3+j]*F[3+i] + R[6+j]*F[6+i]);
  double d0 = S[2] + S[5], d1 = S[0] + S[5], d2 = S[0] + S[2], b = S[1], c = S[3], e = S[4];
  double m0 = d1*d2 - e*e, m1 = c*e + b*d2, m2 = b*e + c*d1, det = 1/(d0*m0 - b*m1 - c*m2);
  T[0] = m0*det; T[1] = m1*det; T[2] = (d0*d2 - c*c)*det;
  T[3] = m2*det; T[4] = (d0*e + b*c)*det; T[5] = (d0*d1 - b*b)*det;
}

/* dr = G L dF */
static inline void polar_first(const double *parameters, const double *R, const double *T, double *G,
                               double *L) {
  const double M[3][3] = {{T[0], T[1], T[3]}, {T[1], T[2], T[4]}, {T[3], T[4], T[5]}};
  for (int i = 0; i < 3; i++) {
    const double *r = R + 3*i, X[3][3] = {{0, -r[2], r[1]}, {r[2], 0, -r[0]}, {-r[1], r[0], 0}};
    for (int j = 0; j < 3; j++) for (int m = 0; m < 3; m++) {
      G[3*(3*i+j)+m] = -X[m][j];
      L[9*m+3*i+j] = M[m][0]*X[j][0] + M[m][1]*X[j][1] + M[m][2]*X[j][2]; } }
}

/* N : d^2 r [dF, dF] = (L dF).C (L dF) + 2 (E dF).(L dF) */
static inline void polar_second(const double *parameters, const double *R, const double *T,
                                const double *N, double *C, double *E) {
  double P[3][3], trace = 0, t[3];
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++)
    P[i][j] = R[i]*N[j] + R[3+i]*N[3+j] + R[6+i]*N[6+j];
  trace = P[0][0] + P[1][1] + P[2][2];
  const double n[3] = {P[2][1] - P[1][2], P[0][2] - P[2][0], P[1][0] - P[0][1]};
  t[0] = T[0]*n[0] + T[1]*n[1] + T[3]*n[2];
  t[1] = T[1]*n[0] + T[2]*n[1] + T[4]*n[2];
  t[2] = T[3]*n[0] + T[4]*n[1] + T[5]*n[2];
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) C[3*i+j] = 0.5*(P[i][j] + P[j][i]) - (i == j)*trace;
  for (int i = 0; i < 3; i++) {
    const double *r = R + 3*i, rt = r[0]*t[0] + r[1]*t[1] + r[2]*t[2];
    for (int j = 0; j < 3; j++) for (int m = 0; m < 3; m++)
      E[9*m+3*i+j] = 0.5*(r[m]*t[j] + (m == j)*rt) - r[j]*t[m]; }
}
