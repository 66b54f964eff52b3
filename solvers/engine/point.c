/* The Newton system of an energy density, point by point; see solvers/engine/kernel.py.

   Before this come `dense.h` and what is made for each density (solvers/engine/source.py): FFCx's functions
   ENERGY, GRADIENT and HESSIAN of it; loops over functions that UFL cannot see through; and the sizes
     DIM        of space            POINTS  of the rule            DATA   numbers of a point without derivative
     FIELDS     in the problem      NA      arguments (values and gradients of fields of the whole cell)
     NL         local unknowns      NR      values of functions    NZ = NA + NL, NY = NZ + NR
     NS, NC     degrees of freedom of a cell shared with others, of its polynomials; NE = NS + NC
     KEPT       numbers kept of a point between residual and matrix
     MULTIPLIERS  of arguments of functions
     RANK       largest of the functions
     COLUMNS, WIDTH   NA + 1 and NE + 1 rounded up
     COUPLED    local unknowns that are coupled with arguments
     PAIRS      of local unknowns whose block is (H, W; W, 0) with W diagonal, but for the order; or 0
     OTHERS     local unknowns beside the pairs
   EACH_ARGUMENT(X): X(field, components, nodes, first dof in the cell, place of its value in y, of its
   gradient, of its basis) for each field of the whole cell, with -1 for what the density does not have;
   EACH_LOCAL(X): X(field, size, place in y).
   y holds the unknowns of a point in the order arguments, local, functions, then its data and a multiplier
   for each argument of a function. Kept of a point are values of functions, the derivatives by them, what
   they keep themselves, and the multipliers. */
typedef struct {
  int cells;
  const int *numbers;            /* of the cells */
  const double *geometry;        /* of each point: inverse Jacobian (by rows), weight times volume */
  const double *basis;           /* of each field and point: value and gradient of each node's function */
  const double *data, *constants;
  double *kept;                  /* KEPT a point */
  double *steps;                 /* NL (NA + 1) a point, then NC (NS + 1) a cell: D^-1 B, D^-1 b */
  const int *const *dofs;        /* by field: of each cell */
  double *const *values;         /* by field */
} Part;

INLINE void basis_at(int nodes, const double *reference, const double *inverse, double (*phi)[nodes]) {
  for (int a = 0; a < nodes; a++, reference += 1 + DIM) {
    phi[0][a] = reference[0];
    for (int j = 0; j < DIM; j++) {
      phi[1+j][a] = 0;
      for (int k = 0; k < DIM; k++) phi[1+j][a] += reference[1+k]*inverse[DIM*k+j]; } }
}

/* Values and gradients z of a field with values U at the nodes. */
INLINE void interpolate(int bs, int nodes, int value, int gradient, double (*phi)[nodes], const double *U, double *z) {
  for (int i = 0; i < bs; i++) {
    if (value >= 0) { z[value+i] = 0; for (int a = 0; a < nodes; a++) z[value+i] += phi[0][a]*U[i*nodes+a]; }
    if (gradient >= 0) for (int j = 0; j < DIM; j++) {
      z[gradient+i*DIM+j] = 0;
      for (int a = 0; a < nodes; a++) z[gradient+i*DIM+j] += phi[1+j][a]*U[i*nodes+a]; } }
}

/* The transpose: adds w B^T z. */
INLINE void distribute(int bs, int nodes, int value, int gradient, double (*phi)[nodes], double w, const double *z,
                       double *U) {
  for (int i = 0; i < bs; i++) for (int j = value < 0; j < 1 + (gradient < 0 ? 0 : DIM); j++) {
    double a = w*(j ? z[gradient+i*DIM+j-1] : z[value+i]);
    add(nodes/4*4, a, phi[j], U + i*nodes);
    for (int n = nodes/4*4; n < nodes; n++) U[i*nodes+n] += a*phi[j][n]; }
}

INLINE void gather(const Part *part, int cell, double *const *values, double *U) {
#define X(f, bs, nodes, first, value, gradient, place) \
  for (int a = 0; a < nodes; a++) for (int i = 0; i < bs; i++) \
    U[first+i*nodes+a] = values[f][bs*(long)part->dofs[f][nodes*(long)cell+a]+i];
  EACH_ARGUMENT(X)
#undef X
}

/* Basis functions at a point, for the loops below. */
#define PHI(f, bs, nodes, first, value, gradient, place) \
  double phi##f[1 + DIM][nodes]; \
  basis_at(nodes, part->basis + POINTS*place + q*nodes*(1 + DIM), geometry, phi##f);

#define LOCAL(values, f, n, cell, q, k) values[f][n*(long)part->dofs[f][POINTS*(long)cell+q]+k]

INLINE void local_values(const Part *part, int cell, int q, double *y) {
#define X(f, n, place) for (int k = 0; k < n; k++) y[place+k] = LOCAL(part->values, f, n, cell, q, k);
  EACH_LOCAL(X)
#undef X
}

INLINE void point(const Part *part, const double *U, int cell, long at, int q, double *y) {
  const double *geometry = part->geometry + at*(DIM*DIM + 1);
#define X(f, bs, nodes, first, value, gradient, place) \
  { PHI(f, bs, nodes, first, value, gradient, place) interpolate(bs, nodes, value, gradient, phi##f, U + first, y); }
  EACH_ARGUMENT(X)
#undef X
  local_values(part, cell, q, y);
  for (int k = 0; k < DATA; k++) y[NY+k] = part->data[at*DATA+k];
}

INLINE double cell_energy(const Part *part, int n) {
  double sum = 0, U[NE + 1], y[NY + DATA + MULTIPLIERS + 1], kept[KEPT + 1];
  gather(part, part->numbers[n], part->values, U);
  for (int q = 0; q < POINTS; q++) {
    long at = (long)n*POINTS + q;
    double w = 0;
    point(part, U, part->numbers[n], at, q, y);
    functions(y, part->constants, kept);
    ENERGY(&w, y, part->constants);
    sum += part->geometry[at*(DIM*DIM+1)+DIM*DIM]*w; }
  return sum;
}

double energy(const Part *part) {
  double sum = 0;
  for (int n = 0; n < part->cells; n++) sum += cell_energy(part, n);
  return sum;
}

/* In cells where the energy has no value, halves the way of local fields from `before` until it has, at most `most`
   times; returns in how many cells. */
int hold(const Part *part, double *const *before, int most) {
  int held = 0;
#if NL + NC
  for (int n = 0; n < part->cells; n++) {
    int cell = part->numbers[n], halvings = 0;
    for (; halvings < most && !isfinite(cell_energy(part, n)); halvings++) {
#define HALVE(value, from) { value = from + (value - from)/2; }
#define X(f, bs, nodes, first, value, gradient, place) \
      if (first >= NS) for (int a = 0; a < nodes; a++) for (int i = 0; i < bs; i++) { \
        long k = bs*(long)part->dofs[f][nodes*(long)cell+a]+i; \
        HALVE(part->values[f][k], before[f][k]) }
      EACH_ARGUMENT(X)
#undef X
#define X(f, size, place) for (int q = 0; q < POINTS; q++) for (int k = 0; k < size; k++) \
        HALVE(LOCAL(part->values, f, size, cell, q, k), LOCAL(before, f, size, cell, q, k))
      EACH_LOCAL(X)
#undef X
#undef HALVE
    }
    held += halvings > 0; }
#endif
  return held;
}

/* Adds the derivatives of the energy to an array for each field, and keeps what the matrix needs. */
void residual(const Part *part, double *const *r) {
  double U[NE + 1], y[NY + DATA + MULTIPLIERS + 1];
  for (int n = 0; n < part->cells; n++) {
    int cell = part->numbers[n];
    double element[NE + 1];
    for (int i = 0; i < NE; i++) element[i] = 0;
    gather(part, cell, part->values, U);
    for (int q = 0; q < POINTS; q++) {
      long at = (long)n*POINTS + q;
      const double *geometry = part->geometry + at*(DIM*DIM + 1), w = geometry[DIM*DIM];
      double *kept = part->kept + at*KEPT, g[NY];
      point(part, U, cell, at, q, y);
      functions(y, part->constants, kept);
      for (int i = 0; i < NY; i++) g[i] = 0;
      GRADIENT(g, y, part->constants);
      pull_back_functions(g, y, part->constants, kept);
      for (int i = 0; i < NR; i++) { kept[i] = y[NZ+i]; kept[NR+i] = g[NZ+i]; }
      for (int i = 0; i < MULTIPLIERS; i++) kept[KEPT-MULTIPLIERS+i] = y[NY+DATA+i];
#define X(f, size, place) for (int k = 0; k < size; k++) LOCAL(r, f, size, cell, q, k) += w*g[place+k];
      EACH_LOCAL(X)
#undef X
#define X(f, bs, nodes, first, value, gradient, place) \
      { PHI(f, bs, nodes, first, value, gradient, place) \
        distribute(bs, nodes, value, gradient, phi##f, w, g, element + first); }
      EACH_ARGUMENT(X)
#undef X
    }
#define X(f, bs, nodes, first, value, gradient, place) \
    for (int a = 0; a < nodes; a++) for (int i = 0; i < bs; i++) \
      r[f][bs*(long)part->dofs[f][nodes*(long)cell+a]+i] += element[first+i*nodes+a];
    EACH_ARGUMENT(X)
#undef X
  }
}

/* 1 in the columns of arguments. */
static const double of_arguments[COLUMNS] = {[0 ... NA - 1] = 1};

/* Eliminates the local unknowns: sets `solution` to D^-1 (B, b), of which the last column is given, and A to
   (H - B^T D^-1 B, -B^T D^-1 b) of arguments. */
INLINE int eliminate(const double *H, double (*solution)[COLUMNS], double (*A)[COLUMNS]) {
#if PAIRS
  double inverse[PAIRS], b[PAIRS], by[NL][OTHERS + 1]; /* the others */
  for (int i = 0; i < PAIRS; i++) {
    int s = strain[i], m = multiplier[i];
    double W = H[(NA+m)*NY+NA+s], x[COLUMNS] = {0};
    if (!(fabs(W) > 0)) return 1;
    inverse[i] = 1/W; b[i] = solution[s][NA];
    add(COLUMNS, inverse[i], H + (NA+m)*NY, x);
    copy(COLUMNS, x, solution[s]);
    for (int k = 0; k < OTHERS; k++) by[s][k] = inverse[i]*H[(NA+m)*NY+NA+other[k]];
    solution[s][NA] = inverse[i]*solution[m][NA]; }
  for (int i = 0; i < PAIRS; i++) {
    const double *h = H + (NA+strain[i])*NY;
    double x[COLUMNS] = {0};
    UNROLL for (int j = 0; j < PAIRS; j++) add(COLUMNS, -inverse[i]*h[NA+strain[j]], solution[strain[j]], x);
    double last = x[NA] + inverse[i]*b[i];
    add(COLUMNS, inverse[i], h, x);
    copy(COLUMNS, x, solution[multiplier[i]]);
    for (int k = 0; k < OTHERS; k++) {
      double sum = h[NA+other[k]];
      for (int j = 0; j < PAIRS; j++) sum -= h[NA+strain[j]]*by[strain[j]][k];
      by[multiplier[i]][k] = inverse[i]*sum; }
    solution[multiplier[i]][NA] = last; }
#if OTHERS
  double D[OTHERS*OTHERS], right[OTHERS][COLUMNS], scale[OTHERS], work[OTHERS*COLUMNS];
  int order[OTHERS];
  for (int k = 0; k < OTHERS; k++) {
    const double *h = H + (NA+other[k])*NY;
    copy(COLUMNS, h, right[k]);
    right[k][NA] = solution[other[k]][NA];
    for (int l = 0; l < OTHERS; l++) D[k*OTHERS+l] = h[NA+other[l]];
    for (int i = 0; i < 2*PAIRS; i++) {
      add(COLUMNS, -h[NA+paired[i]], solution[paired[i]], right[k]);
      for (int l = 0; l < OTHERS; l++) D[k*OTHERS+l] -= h[NA+paired[i]]*by[paired[i]][l]; } }
  if (solve(OTHERS, COLUMNS, D, OTHERS, right[0], COLUMNS, scale, order, work)) return 1;
  for (int k = 0; k < OTHERS; k++) {
    for (int i = 0; i < 2*PAIRS; i++) add(COLUMNS, -by[paired[i]][k], right[k], solution[paired[i]]);
    copy(COLUMNS, right[k], solution[other[k]]); }
#endif
#elif NL
  double D[NL*NL], scale[NL], work[NL*COLUMNS];
  int order[NL];
  for (int i = 0; i < NL; i++) {
    memcpy(D + i*NL, H + (NA+i)*NY + NA, NL*sizeof(double));
    memcpy(solution[i], H + (NA+i)*NY, NA*sizeof(double)); }
  if (solve(NL, COLUMNS, D, NL, solution[0], COLUMNS, scale, order, work)) return 1;
#endif
  for (int p = 0; p < NA; p++) {
    double x[COLUMNS];
    for (int i = 0; i < COLUMNS/4; i++) ((V *)x)[i] = ((const V *)(H + p*NY))[i]*((const V *)of_arguments)[i];
    UNROLL for (int i = 0; i < COUPLED; i++) add(COLUMNS, -H[(NA+coupled[i])*NY+p], solution[coupled[i]], x);
    copy(COLUMNS, x, A[p]); }
  return 0;
}

/* Has the blocks of K that a cell adds to brought near while its matrix is made. */
INLINE void fetch(int cell, double *const *K, const int *const *places) {
  for (int f = 0; f < SHARED; f++) for (int h = 0; h < SHARED; h++) {
    int blocks = shared[f].nodes*shared[h].nodes, size = shared[f].components*shared[h].components;
    const int *place = places[f*SHARED+h] + (long)cell*blocks;
    for (int a = 0; a < blocks; a++) {
      __builtin_prefetch(K[f*SHARED+h] + (long)place[a]*size, 1);
      __builtin_prefetch(K[f*SHARED+h] + (long)place[a]*size + size - 1, 1); } }
}

/* Adds the condensed matrix to blocks of K by pair of shared fields, and -B^T D^-1 b to g of shared fields.
   projection: 1, 2 and 3 change the matrix of a point by `project`, its absolute variant and `spread`, in the
   cells with marks if these are given. b: the right-hand side of the other fields. lift: if given, changes of
   shared fields that are known, which go to g as -K lift. squares: if given, gets the sum of squares of local
   entries by pair of fields, and their number. Returns 1 or 2, and the block, if that of a point or a cell is
   singular. */
int matrix(const Part *part, int projection, const signed char *marks, double *const *b, double *const *K,
           const int *const *places, double *const *g, double *const *lift, double *squares, double *singular) {
  double U[NE + 1], y[NY + DATA + MULTIPLIERS + 1];
  for (int n = 0; n < part->cells; n++) {
    int cell = part->numbers[n], change = marks && !marks[cell] ? 0 : projection;
    double Ke[NE][WIDTH] = {{0}};
    fetch(cell, K, places);
    gather(part, cell, part->values, U);
    for (int q = 0; q < POINTS; q++) {
      long at = (long)n*POINTS + q;
      const double *geometry = part->geometry + at*(DIM*DIM + 1), w = geometry[DIM*DIM];
      const double *kept = part->kept + at*KEPT;
      double H[NY*NY+COLUMNS] = {0}, A[NA][COLUMNS], AB[NA][WIDTH] = {{0}}, solution[NL + 1][COLUMNS] = {{0}};
      double *steps = part->steps + at*NL*(NA+1);
      point(part, U, cell, at, q, y);
      for (int i = 0; i < NR; i++) y[NZ+i] = kept[i];
      for (int i = 0; i < MULTIPLIERS; i++) y[NY+DATA+i] = kept[KEPT-MULTIPLIERS+i];
      HESSIAN(H, y, part->constants);
      chain_functions(H, y, part->constants, kept);
      if (squares) for (int i = 0; i < NL; i++) for (int j = 0; j < NL; j++) {
        double d = w*H[(NA+i)*NY+NA+j], *s = squares + 2*(local_field[i]*FIELDS + local_field[j]);
        s[0] += d*d; s[1] += d != 0; }
#define X(f, size, place) for (int k = 0; k < size; k++) solution[place-NA+k][NA] = LOCAL(b, f, size, cell, q, k)/w;
      EACH_LOCAL(X)
#undef X
      if (eliminate(H, solution, A)) {
        for (int i = 0; i < NL; i++) memcpy(singular + i*NL, H + (NA+i)*NY + NA, NL*sizeof(double));
        return 1; }
      for (int i = 0; i < NL; i++) for (int p = 0; p <= NA; p++) steps[i*(NA+1)+p] = solution[i][p];
      if (change == 3) spread(NA, A[0], COLUMNS);
      else if (change && !NC) project(NA, A[0], COLUMNS, change == 2);
      for (int p = 0; p < NA; p++) {
        if (NE % 4) AB[p][NE] = A[p][NA];
        else *(V *)(AB[p] + NE) = (V){A[p][NA]}; }
#define X(f, bs, nodes, first, value, gradient, place) \
      PHI(f, bs, nodes, first, value, gradient, place) \
      for (int p = 0; p < NA; p++) distribute(bs, nodes, value, gradient, phi##f, 1, A[p], AB[p] + first);
      EACH_ARGUMENT(X)
#undef X
#define X(f, bs, nodes, first, value, gradient, place) \
      if (squares) for (int i = 0; i < NL; i++) { \
        double row[bs*nodes], *s = squares + 2*(local_field[i]*FIELDS + f); \
        for (int e = 0; e < bs*nodes; e++) row[e] = 0; \
        distribute(bs, nodes, value, gradient, phi##f, w, H + (NA+i)*NY, row); \
        for (int e = 0; e < bs*nodes; e++) { s[0] += row[e]*row[e]; s[1] += row[e] != 0; } }
      EACH_ARGUMENT(X)
#undef X
#define X(f, bs, nodes, first, value, gradient, place) \
      for (int i = 0; i < bs; i++) for (int a = 0; a < nodes; a++) { \
        double *row = Ke[first+i*nodes+a]; \
        if (value >= 0) add(WIDTH, w*phi##f[0][a], AB[value+i], row); \
        if (gradient >= 0) for (int k = 0; k < DIM; k++) add(WIDTH, w*phi##f[1+k][a], AB[gradient+i*DIM+k], row); }
      EACH_ARGUMENT(X)
#undef X
    }
#if NC
    double C[NC*NC], scale[NC], work[NC*(NS+1)];
    double *solution = part->steps + (long)part->cells*POINTS*NL*(NA+1) + (long)n*NC*(NS+1);
    int order[NC];
#define X(f, bs, nodes, first, value, gradient, place) \
    if (first >= NS) for (int a = 0; a < nodes; a++) for (int i = 0; i < bs; i++) \
      Ke[first+i*nodes+a][NE] += b[f][bs*(long)part->dofs[f][nodes*(long)cell+a]+i];
    EACH_ARGUMENT(X)
#undef X
    for (int i = 0; i < NC; i++) {
      for (int j = 0; j < NC; j++) {
        double d = C[i*NC+j] = Ke[NS+i][NS+j];
        if (squares) {
          double *s = squares + 2*(cellwise_field[i]*FIELDS + cellwise_field[j]);
          s[0] += d*d; s[1] += d != 0; } }
      for (int j = 0; j < NS; j++) solution[i*(NS+1)+j] = Ke[NS+i][j];
      solution[i*(NS+1)+NS] = Ke[NS+i][NE]; }
    if (solve(NC, NS + 1, C, NC, solution, NS + 1, scale, order, work)) {
      for (int i = 0; i < NC; i++) memcpy(singular + i*NC, Ke[NS+i] + NS, NC*sizeof(double));
      return 2; }
    for (int k = 0; k < NC; k++) for (int i = 0; i < NS; i++) {
      for (int j = 0; j < NS; j++) Ke[i][j] -= Ke[NS+k][i]*solution[k*(NS+1)+j];
      Ke[i][NE] -= Ke[NS+k][i]*solution[k*(NS+1)+NS]; }
    if (change && change < 3) project(NS, Ke[0], WIDTH, change == 2);
#endif
    if (lift) {
      gather(part, cell, lift, U);
      for (int i = 0; i < NS; i++) for (int j = 0; j < NS; j++) Ke[i][NE] -= Ke[i][j]*U[j]; }
    for (int f = 0; f < SHARED; f++) {
      int bs = shared[f].components, nodes = shared[f].nodes, row = shared[f].first;
      for (int a = 0; a < nodes; a++) for (int i = 0; i < bs; i++)
        g[f][bs*(long)part->dofs[shared[f].field][nodes*(long)cell+a]+i] += Ke[row+i*nodes+a][NE];
      for (int h = 0; h < SHARED; h++) {
        int cs = shared[h].components, columns = shared[h].nodes, column = shared[h].first;
        const int *place = places[f*SHARED+h] + (long)cell*nodes*columns;
        for (int a = 0; a < nodes; a++) for (int c = 0; c < columns; c++) {
          double *block = K[f*SHARED+h] + (long)place[a*columns+c]*bs*cs;
          for (int i = 0; i < bs; i++) for (int j = 0; j < cs; j++)
            block[i*cs+j] += Ke[row+i*nodes+a][column+j*columns+c]; } } }
  }
  return 0;
}

/* Sets the changes of local fields and polynomials that go with changes of shared fields, both in `changes`. */
void recover(const Part *part, double *const *changes) {
  double U[NE + 1], z[NA + 1];
  for (int n = 0; n < part->cells; n++) {
    int cell = part->numbers[n];
    gather(part, cell, changes, U);
#if NC
    const double *solution = part->steps + (long)part->cells*POINTS*NL*(NA+1) + (long)n*NC*(NS+1);
    for (int i = 0; i < NC; i++, solution += NS + 1) {
      U[NS+i] = solution[NS];
      for (int j = 0; j < NS; j++) U[NS+i] -= solution[j]*U[j]; }
#define X(f, bs, nodes, first, value, gradient, place) \
    if (first >= NS) for (int a = 0; a < nodes; a++) for (int i = 0; i < bs; i++) \
      changes[f][bs*(long)part->dofs[f][nodes*(long)cell+a]+i] = U[first+i*nodes+a];
    EACH_ARGUMENT(X)
#undef X
#endif
    for (int q = 0; q < POINTS; q++) {
      long at = (long)n*POINTS + q;
      const double *geometry = part->geometry + at*(DIM*DIM + 1), *x = part->steps + at*NL*(NA+1);
      double step[NL + 1];
#define X(f, bs, nodes, first, value, gradient, place) \
      { PHI(f, bs, nodes, first, value, gradient, place) interpolate(bs, nodes, value, gradient, phi##f, U + first, z); }
      EACH_ARGUMENT(X)
#undef X
      for (int i = 0; i < NL; i++, x += NA + 1) {
        step[i] = x[NA];
        for (int p = 0; p < NA; p++) step[i] -= x[p]*z[p]; }
#define X(f, size, place) for (int k = 0; k < size; k++) LOCAL(changes, f, size, cell, q, k) = step[place-NA+k];
      EACH_LOCAL(X)
#undef X
    }
  }
}
