//! Which blocks of a symmetric matrix are there, and where their values lie.

/// The upper triangle of a symmetric block matrix, by block columns with ascending rows; diagonals are always there.
///
/// Values lie as compressed sparse columns: scalar column after scalar column, rows ascending, upper triangle only.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BlockPattern {
    /// First unknown of each block, then their number.
    offsets: Vec<usize>,
    /// First entry of each block column in `rows`, then their number.
    column_start: Vec<usize>,
    /// Block rows of the entries.
    rows: Vec<u32>,
    /// Rows above the entry in its column.
    rows_above: Vec<u32>,
    /// First value of each block column, then their number.
    value_start: Vec<usize>,
}

impl BlockPattern {
    /// A pattern from the blocks' sizes and, for each block column, its rows above the diagonal (any order, repeats
    /// allowed; rows not above the diagonal are ignored).
    pub fn new(dims: &[usize], mut above: Vec<Vec<u32>>) -> Self {
        above.resize(dims.len(), Vec::new());
        let mut pattern = Self {
            offsets: vec![0],
            column_start: vec![0],
            rows: Vec::new(),
            rows_above: Vec::new(),
            value_start: vec![0],
        };
        for (column, mut rows) in above.into_iter().enumerate() {
            rows.retain(|row| (*row as usize) < column);
            rows.sort_unstable();
            rows.dedup();
            let mut height = 0;
            for row in rows.into_iter().chain([column as u32]) {
                pattern.rows.push(row);
                pattern.rows_above.push(height as u32);
                height += dims[row as usize];
            }
            let dim = dims[column];
            // The diagonal block holds only its upper triangle.
            let num_values = (height - dim) * dim + dim * (dim + 1) / 2;
            pattern.offsets.push(pattern.offsets[column] + dim);
            pattern.column_start.push(pattern.rows.len());
            pattern.value_start.push(pattern.value_start[column] + num_values);
        }
        pattern
    }

    /// Every block of the upper triangle.
    pub fn full(dims: &[usize]) -> Self {
        Self::new(dims, (0..dims.len() as u32).map(|column| (0..column).collect()).collect())
    }

    /// Number of blocks along a side.
    pub fn num_blocks(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Number of scalar unknowns.
    pub fn num_unknowns(&self) -> usize {
        self.offsets.last().copied().unwrap_or(0)
    }

    /// Number of values of the upper triangle.
    pub fn num_values(&self) -> usize {
        self.value_start.last().copied().unwrap_or(0)
    }

    /// First unknown of a block.
    pub fn offset(&self, block: usize) -> usize {
        self.offsets[block]
    }

    /// Number of unknowns of a block.
    pub fn dim(&self, block: usize) -> usize {
        self.offsets[block + 1] - self.offsets[block]
    }

    /// The block rows of a block column, ascending, the diagonal last.
    pub fn rows_of(&self, column: usize) -> &[u32] {
        &self.rows[self.column_start[column]..self.column_start[column + 1]]
    }

    /// The position of a block, if the pattern has it.
    #[inline]
    pub(super) fn find(&self, row: usize, column: usize) -> Option<usize> {
        let rows = self.rows_of(column);
        // Full columns, as in dense systems, need no search.
        if rows.len() == column + 1 {
            return (row <= column).then(|| self.column_start[column] + row);
        }
        rows.binary_search(&(row as u32)).ok().map(|at| self.column_start[column] + at)
    }

    /// Index of the first value of scalar column `component` of the block at `position` in block column `column`.
    #[inline]
    pub(super) fn value_index(&self, position: usize, column: usize, component: usize) -> usize {
        let last = self.column_start[column + 1] - 1;
        let above_diagonal = self.rows_above[last] as usize;
        let before = component * above_diagonal + component * (component + 1) / 2;
        self.value_start[column] + before + self.rows_above[position] as usize
    }

    /// Compressed sparse columns of the upper triangle: column starts and row indices, scalar.
    pub(super) fn scalar_columns(&self) -> (Vec<usize>, Vec<usize>) {
        let mut starts = Vec::with_capacity(self.num_unknowns() + 1);
        let mut indices = Vec::with_capacity(self.num_values());
        starts.push(0);
        for column in 0..self.num_blocks() {
            for component in 0..self.dim(column) {
                for &row in self.rows_of(column) {
                    let row = row as usize;
                    let height = if row == column { component + 1 } else { self.dim(row) };
                    indices.extend(self.offsets[row]..self.offsets[row] + height);
                }
                starts.push(indices.len());
            }
        }
        (starts, indices)
    }

    /// Compressed sparse columns of the upper triangle of blocks.
    pub(super) fn block_columns(&self) -> (Vec<usize>, Vec<usize>) {
        (self.column_start.clone(), self.rows.iter().map(|row| *row as usize).collect())
    }
}
